"""One coloured point cloud for each instance of a frame (paper, section "Recognition").

Pixels with valid depth are put on a voxel grid of 3 mm, and outliers are removed. An instance that cannot be used is
not dropped: its `reason` says why.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.frames import MAX_DEPTH, MIN_DEPTH, RGBDFrame, pixel_rays
from thor2_jax.recognition.outlier_removal import flying_pixels, remove_outliers
from thor2_jax.recognition.voxel_grid import voxel_downsample

__all__ = ["MAX_DEPTH", "MIN_DEPTH", "MIN_POINTS", "InstanceCloud", "instance_cloud", "instance_clouds"]

CLOUD_VOXEL = 0.003
"""Voxel side of the grid on which outliers are removed, metres."""

MIN_POINTS = 30
"""Least number of points on that grid; an instance with fewer cannot be used."""


@dataclasses.dataclass(frozen=True, eq=False)
class InstanceCloud:
    """The point cloud of an instance.

    Attributes:
        label: its number in the label image.
        points: [n, 3] float32, metres, OpenCV camera frame.
        colors: [n, 3] uint8, sRGB.
        n_pixels: number of pixels of its mask.
        kept_by_fallback: a rule of outlier removal would have dropped most of it and was skipped.
        reason: why the cloud cannot be used; None if it can.
    """

    label: int
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    n_pixels: int
    kept_by_fallback: bool = False
    reason: str | None = None


def instance_clouds(frame: RGBDFrame) -> list[InstanceCloud]:
    """Return the clouds of all instances in the order of `frame.instances`, including those that cannot be used."""
    return [instance_cloud(frame, label) for label in frame.instances]


def instance_cloud(frame: RGBDFrame, label: int) -> InstanceCloud:
    """Return the cloud of one instance; if it cannot be used, with a `reason`.

    Args:
        frame: the frame.
        label: one of `frame.instances`.
    """
    pixels = frame.instance_pixels[label]
    depth = frame.depth_m.ravel()[pixels]
    trusted = (depth >= MIN_DEPTH) & (depth <= MAX_DEPTH)
    flying = flying_pixels(frame, pixels)
    steep = 2 * int((trusted & ~flying).sum()) < int(trusted.sum())
    if not steep:
        trusted &= ~flying
    valid, depth = pixels[trusted], depth[trusted]
    points = (pixel_rays(valid, frame.depth.shape[1], frame.intrinsics) * depth[:, None]).astype(np.float32)
    points, colors = voxel_downsample(points, frame.color.reshape(-1, 3).take(valid, axis=0), CLOUD_VOXEL)
    if len(points) < MIN_POINTS:
        reason = (
            f"{len(points)} points ({len(pixels)} pixels, {len(valid)} of them with depth "
            f"from {MIN_DEPTH} to {MAX_DEPTH} m); expected at least {MIN_POINTS}{_unit_question(frame)}"
        )
        return InstanceCloud(label, points, colors, len(pixels), reason=reason)
    kept, relaxed = remove_outliers(points)
    return InstanceCloud(label, points.take(kept, axis=0), colors.take(kept, axis=0), len(pixels), steep or relaxed)


def _unit_question(frame: RGBDFrame) -> str:
    """Ask whether the unit of depth is right if no instance of the frame has usable depth."""
    if frame.has_usable_depth:
        return ""
    if frame.depth.dtype.kind == "f":
        return "; no instance has such depth: is depth, in floating point, in metres?"
    return f"; no instance has such depth: is depth_scale right? It is {frame.intrinsics.depth_scale:g} units per metre"
