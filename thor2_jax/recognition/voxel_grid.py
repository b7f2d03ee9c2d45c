"""Voxel grid: one point a cube, the mean of the points in it (the rule of Open3D's `voxel_down_sample`)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.capacity import point_bucket
from thor2_jax.errors import InputError

__all__ = ["downsample_to_fit", "voxel_downsample"]


def voxel_downsample(
    points: NDArray[np.floating[Any]], colors: NDArray[Any], size: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Replace the points of each cube by their mean, and their colours by theirs.

    The grid starts half a cube below the cloud's least coordinates, as Open3D's does.

    Args:
        points: [n, 3] floats, n may be 0.
        colors: [n, c] uint8 or floats.
        size: side of a cube, in the points' unit.

    Returns:
        points [m, 3] and colors [m, c] of the types given (uint8 means are rounded, halves up), cubes in lexicographic
        order.

    Raises:
        InputError: a size that is not positive, points that are not finite, or other shapes.
    """
    if not size > 0:
        raise InputError(f"size is {size!r}; it must be positive")
    if points.ndim != 2 or points.shape[1] != 3 or colors.ndim != 2 or len(colors) != len(points):
        raise InputError(f"points and colors have shapes {points.shape} and {colors.shape}; expected [n, 3] and [n, c]")
    if len(points) == 0:
        return points.copy(), colors.copy()
    if not np.isfinite(points).all():
        raise InputError(f"points has {int((~np.isfinite(points)).any(axis=1).sum())} points that are not finite")
    exact = points.T.astype(np.float64, order="C")  # planes: three reductions over memory in a row
    cubes = np.floor((exact - (exact.min(axis=1, keepdims=True) - size / 2)) / size).astype(np.int64)
    extent = cubes.max(axis=1) + 1
    if float(extent[0]) * float(extent[1]) * float(extent[2]) >= 2**62:
        raise InputError(f"size is {size!r}; too small for a cloud that spans {np.ptp(exact, axis=1).tolist()}")
    key = (cubes[0] * extent[1] + cubes[1]) * extent[2] + cubes[2]
    # In place of `np.unique`: pixels come in rows, and a stable sort makes use of what is in order already.
    order = np.argsort(key, kind="stable")
    cube = np.empty_like(order)
    in_order = key.take(order)
    cube[order[0]], cube[order[1:]] = 0, np.cumsum(in_order[1:] != in_order[:-1])
    counts = np.bincount(cube)

    def mean(planes: NDArray[Any]) -> NDArray[np.float64]:
        return np.stack([np.bincount(cube, weights=plane) / counts for plane in planes], axis=1)

    mean_colors = mean(colors.T)
    if colors.dtype == np.uint8:
        mean_colors = np.floor(mean_colors + 0.5)
    return mean(exact).astype(points.dtype), mean_colors.astype(colors.dtype)


def downsample_to_fit(
    points: NDArray[np.floating[Any]], colors: NDArray[Any], size: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """`voxel_downsample`, with a side twice as large as long as no bucket holds the cloud."""
    while True:
        found = voxel_downsample(points, colors, size)
        try:
            point_bucket(len(found[0]))
        except InputError:
            size *= 2
        else:
            return found
