"""Prepared instances: what the recognizer describes of each instance of a frame, computed on the host.

Preparation is pure NumPy and its results can be pickled, so it can run in other processes than the recognizer.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.instance_clouds import InstanceCloud, instance_cloud
from thor2_jax.recognition.occlusion import find_occlusion
from thor2_jax.recognition.voxel_grid import downsample_to_fit
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
    """

    label: int
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    boundary: NDArray[np.bool_]
    occluded: bool = False
    kept_by_fallback: bool = False
    reason: str | None = None


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
    points, colors, boundary = _downsample(cloud, occlusion.boundary, DESCRIPTOR_VOXEL / sigma_s)
    return PreparedInstance(label, points, colors, boundary, occlusion.occluded, cloud.kept_by_fallback)


def _downsample(
    cloud: InstanceCloud, boundary: NDArray[np.bool_], size: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    """Return points and colours on the voxel grid, and which voxels hold a boundary point."""
    # The boundary is a fourth colour channel: the mean over a voxel is above 0 if one of its points is marked.
    channels = np.column_stack([cloud.colors, boundary * np.uint8(255)])
    points, channels = downsample_to_fit(cloud.points, channels, size)
    return points, channels[:, :3], channels[:, 3] > 0


def pack_instances(instances: Sequence[PreparedInstance], n_rows: int, capacity: int | None = None) -> PointClouds:
    """Pack instances as a batch of `n_rows` clouds in host memory; the last ones are empty.

    Args:
        instances: at most `n_rows`.
        n_rows: B, clouds in the batch.
        capacity: N, points in a row; by default the bucket of the largest cloud, see `PointClouds.pack`.
    """
    padded = [*instances, *[EMPTY_INSTANCE] * (n_rows - len(instances))]
    clouds = [(instance.points, instance.colors) for instance in padded]
    return PointClouds.pack(clouds, capacity, boundary=[instance.boundary for instance in padded], on_host=True)
