"""Voxel grid: replaces the points of each voxel by their mean, as Open3D's `voxel_down_sample` does."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.errors import InputError

__all__ = ["downsample_to_fit", "voxel_downsample"]


def voxel_downsample(
    points: NDArray[np.floating[Any]], colors: NDArray[Any], size: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Replace the points and colours of each voxel by their means.

    The grid starts half a voxel below the smallest coordinates of the cloud, as in Open3D.

    Args:
        points: [n, 3] floats; n may be 0.
        colors: [n, c] uint8 or floats.
        size: side length of a voxel, in the unit of the points.

    Returns:
        points [m, 3] and colors [m, c] in the dtypes of the input, voxels in lexicographic order; means of uint8 are
        rounded, halves up.

    Raises:
        InputError: The size is not positive or too small for the cloud, points are not finite, or shapes are invalid.
    """
    if not size > 0:
        raise InputError(f"size is {size!r}; expected a positive number")
    if points.ndim != 2 or points.shape[1] != 3 or colors.ndim != 2 or len(colors) != len(points):
        raise InputError(f"points and colors have shapes {points.shape} and {colors.shape}; expected [n, 3] and [n, c]")
    if len(points) == 0:
        return points.copy(), colors.copy()
    if not np.isfinite(points).all():
        n_invalid = int((~np.isfinite(points)).any(axis=1).sum())
        raise InputError(f"points has {n_invalid} rows that are not finite; expected finite coordinates")
    exact = points.T.astype(np.float64, order="C")  # coordinates in contiguous rows, which reductions read faster
    cubes = np.floor((exact - (exact.min(axis=1, keepdims=True) - size / 2)) / size).astype(np.int64)
    extent = cubes.max(axis=1) + 1
    if float(extent[0]) * float(extent[1]) * float(extent[2]) >= 2**62:
        sides = np.ptp(exact, axis=1).tolist()
        raise InputError(f"size is {size!r}; expected a larger one for a cloud with side lengths {sides}")
    key = (cubes[0] * extent[1] + cubes[1]) * extent[2] + cubes[2]
    # Faster than `np.unique`: pixels come in rows, and a stable sort benefits from entries that are already in order.
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
    """Call `voxel_downsample` with the size doubled until the cloud fits into the largest bucket."""
    downsampled = voxel_downsample(points, colors, size)
    while len(downsampled[0]) > POINT_BUCKETS[-1]:
        size *= 2
        downsampled = voxel_downsample(points, colors, size)
    return downsampled
