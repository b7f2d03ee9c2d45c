"""Prepared instances: the clouds of a frame's instances, computed on the host.

Preparation is pure NumPy and its results can be pickled, so it can run in other processes than the recognizer.
"""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.instance_clouds import instance_cloud
from thor2_jax.frames.occlusion import find_occlusion
from thor2_jax.frames.voxel_grid import downsample_to_fit

if TYPE_CHECKING:
    from thor2_jax.types import PointClouds

__all__ = ["DESCRIPTOR_VOXEL", "EMPTY_INSTANCE", "PreparedInstance", "pack_instances", "prepare_instance"]

DESCRIPTOR_VOXEL = 0.01
"""Voxel side, in scaled units, of every cloud that is described, in training too: colour vectors count points."""


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedInstance:
    """An instance of a frame, ready to be described: its cloud on the descriptors' voxel grid.

    Attributes:
        label: its number in the label image.
        points: [n, 3] float32, metres, OpenCV camera frame; empty if the instance cannot be used.
        colors: [n, 3] uint8, sRGB.
        boundary: [n] bool, points on the occlusion boundary; all False if the instance is not occluded.
        occluded: another instance hides a part of it, or the image border cuts it.
        kept_by_fallback: a rule of outlier removal would have dropped most of it and was skipped.
        reason: why the instance cannot be used; None if it can.
        rim: [n] bool, points near the contour of the mask, if less than half of them; None without a mask.
    """

    label: int
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    boundary: NDArray[np.bool_]
    occluded: bool = False
    kept_by_fallback: bool = False
    reason: str | None = None
    rim: NDArray[np.bool_] | None = None


EMPTY_INSTANCE = PreparedInstance(0, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool))
"""An instance without points, which pads a batch."""


def prepare_instance(frame: RGBDFrame, label: int, sigma_s: float) -> PreparedInstance:
    """Compute the cloud of one instance and its occlusion boundary, on the descriptors' voxel grid.

    Args:
        frame: the frame.
        label: one of `frame.instances`.
        sigma_s: scaled units per metre, see `DescriptorConfig`.
    """
    cloud = instance_cloud(frame, label)
    if cloud.reason is not None:
        return dataclasses.replace(EMPTY_INSTANCE, label=label, reason=cloud.reason)
    occlusion = find_occlusion(frame, cloud)
    # Flags are further colour channels: a voxel is on the boundary if any of its points is, on the rim if most are.
    flags = np.column_stack([cloud.colors, np.stack([occlusion.boundary, cloud.rim], axis=1) * np.uint8(255)])
    points, channels = downsample_to_fit(cloud.points, flags, DESCRIPTOR_VOXEL / sigma_s)
    boundary, rim = channels[:, 3] > 0, channels[:, 4] > 127
    if 2 * rim.sum() > len(rim):  # a narrow object has no inside
        rim[:] = False
    colors = channels[:, :3]
    return PreparedInstance(label, points, colors, boundary, occlusion.occluded, cloud.kept_by_fallback, rim=rim)


def pack_instances(instances: Sequence[PreparedInstance], n_rows: int, capacity: int | None = None) -> "PointClouds":
    """Pack instances as a batch of `n_rows` clouds in host memory; the last ones are empty.

    Args:
        instances: at most `n_rows`.
        n_rows: B, clouds in the batch.
        capacity: N, points in a row; by default the bucket of the largest cloud, see `PointClouds.pack`.
    """
    from thor2_jax.types import PointClouds  # imports JAX, which preparation does not need

    padded = [*instances, *[EMPTY_INSTANCE] * (n_rows - len(instances))]
    clouds = [(instance.points, instance.colors) for instance in padded]
    boundary, rim = [instance.boundary for instance in padded], [instance.rim for instance in padded]
    return PointClouds.pack(clouds, capacity, boundary=boundary, rim=rim, on_host=True)
