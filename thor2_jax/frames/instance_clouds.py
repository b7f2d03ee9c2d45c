"""One coloured point cloud for each instance of a frame (paper, section "Recognition").

Pixels with valid depth are put on a voxel grid of 3 mm, and outliers are removed. An instance that cannot be used is
not dropped: its `reason` says why.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, RGBDFrame, pixel_points
from thor2_jax.frames.outlier_removal import flying_pixels, remove_outliers
from thor2_jax.frames.voxel_grid import voxel_downsample

__all__ = ["MIN_POINTS", "InstanceCloud", "instance_cloud", "instance_clouds", "unit_question"]

CLOUD_VOXEL = 0.003
"""Voxel side of the grid on which outliers are removed, metres."""

RIM = 2
"""Width of the rim of a mask, pixels: masks reach over the edges of their objects."""

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
        rim: [n] bool, points of pixels within `RIM` of the contour of the mask.
        kept_by_fallback: a rule of outlier removal would have dropped most of it and was skipped.
        reason: why the cloud cannot be used; None if it can.
    """

    label: int
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    n_pixels: int
    rim: NDArray[np.bool_]
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
    points = pixel_points(valid, depth, frame.depth.shape[1], frame.intrinsics)
    flags = _near_contour(frame, label, pixels)[trusted] * np.uint8(255)
    channels = np.column_stack([frame.color.reshape(-1, 3).take(valid, axis=0), flags])
    points, channels = voxel_downsample(points, channels, CLOUD_VOXEL)
    colors, rim = channels[:, :3], channels[:, 3] > 127
    if len(points) < MIN_POINTS:
        reason = (
            f"{len(points)} points ({len(pixels)} pixels, {len(valid)} of them with depth "
            f"from {MIN_DEPTH} to {MAX_DEPTH} m); expected at least {MIN_POINTS}"
        )
        if not frame.has_usable_depth:
            reason += f"; no instance has such depth: {unit_question(frame)}"
        return InstanceCloud(label, points, colors, len(pixels), rim, reason=reason)
    kept, relaxed = remove_outliers(points)
    return InstanceCloud(
        label, points.take(kept, axis=0), colors.take(kept, axis=0), len(pixels), rim.take(kept), steep or relaxed
    )


def _near_contour(frame: RGBDFrame, label: int, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pixels [n] of a mask are within `RIM` of one that is not in it; the image border is no contour."""
    height, width = frame.depth.shape
    row, column = np.divmod(pixels, width)
    top, left = max(row.min() - RIM, 0), max(column.min() - RIM, 0)
    window = frame.label_image[top : row.max() + RIM + 1, left : column.max() + RIM + 1] == label
    inside = ndimage.minimum_filter(window, 2 * RIM + 1, mode="nearest")
    return ~inside[row - top, column - left]


def unit_question(frame: RGBDFrame) -> str:
    """Ask whether the unit of a frame's depth is right."""
    if frame.depth.dtype.kind == "f":
        return "is depth, in floating point, in metres?"
    return f"is depth_scale right? It is {frame.intrinsics.depth_scale:g} units per metre"
