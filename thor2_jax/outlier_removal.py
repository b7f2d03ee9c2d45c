"""Outlier removal on one instance (paper, section "Recognition"): what a depth camera and a mask add to an object.

A mask reaches past its object's edge, onto the background and onto pixels that "fly" between the two. Three rules:
pixels at a step in depth fly; points with too few others around them are strays; small pieces apart from the rest are
background.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from thor2_jax.frames import RGBDFrame

__all__ = ["flying_pixels", "remove_outliers"]

STEEPEST = 15.0
"""Steepest depth, in pixel widths a pixel, that a surface is seen at (86 degrees from facing the camera)."""

NEIGHBORS = 30
"""On a voxel grid of 3 mm. On a plane so many lie within 9 mm, at its corners within 19 mm."""

FARTHEST = 0.016
"""Metres: largest mean distance of a point to its `NEIGHBORS` nearest others. At the corner of a plane it is 12 mm."""

INNER_CELL = 0.006
"""Metres: side of the cells that tell surrounded points: more than `NEIGHBORS` in a cell and those that it touches.
On a grid of 3 mm their mean distance is 14 mm or less, so they need no search."""

CELL = 0.01
"""Metres: side of the cells in which pieces are looked for. Cells that touch, also at a corner, are one piece."""

MIN_SHARE = 0.1
"""Pieces with a smaller share of the largest piece's points are dropped."""


def flying_pixels(frame: RGBDFrame, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Pixels behind a step in depth from one of the four beside them, within the same instance: no surface is so steep.

    Args:
        frame: the frame.
        pixels: [n] flat indices of pixels of one instance.

    Returns:
        [n] bool; False where there is no depth.
    """
    height, width = frame.labels.shape
    labels, depth = frame.labels.ravel(), frame.depth_m.ravel()
    row, column = np.divmod(pixels, width)
    step = STEEPEST * depth[pixels] / frame.intrinsics.fx
    flying = np.zeros(len(pixels), bool)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        r, c = row + down, column + right
        inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        beside = np.where(inside, r * width + c, pixels)
        same = (labels[beside] == labels[pixels]) & (depth[beside] > 0)
        flying |= same & (depth[pixels] - depth[beside] > step)
    return flying


def _cells(points: NDArray[Any], size: float) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Cell of each point [n] on a grid, number of points in each cell [m], and pairs [p, 2] of cells that touch."""
    place = np.floor(points / size).astype(np.int64)
    place -= place.min(axis=0)
    extent = place.max(axis=0) + 1
    keys, cell, counts = np.unique(np.ravel_multi_index(place.T, extent), return_inverse=True, return_counts=True)
    centres = np.stack(np.unravel_index(keys, extent), axis=1)
    return cell, counts, KDTree(centres).query_pairs(1.8, output_type="ndarray")  # 1.73: touching at a corner


def _among_others(points: NDArray[Any]) -> NDArray[np.bool_]:
    if len(points) <= NEIGHBORS:
        return np.zeros(len(points), bool)
    # Most points are surrounded on all sides. Only the others, along edges, are worth the search for neighbours.
    cell, counts, pairs = _cells(points, INNER_CELL)
    i, j = pairs.T
    around = counts + np.bincount(i, counts[j], len(counts)) + np.bincount(j, counts[i], len(counts))
    among = around[cell] > NEIGHBORS
    rest = np.flatnonzero(~among)
    distances = KDTree(points).query(points[rest], k=NEIGHBORS + 1)[0][:, 1:]
    among[rest] = distances.mean(axis=1) <= FARTHEST
    return among


def _in_large_piece(points: NDArray[Any]) -> NDArray[np.bool_]:
    cell, counts, pairs = _cells(points, CELL)
    i, j = pairs.T
    graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(counts), len(counts)))
    piece = connected_components(graph, directed=False)[1]
    size = np.bincount(piece, counts)
    return np.asarray(size[piece[cell]] >= MIN_SHARE * size.max())


def remove_outliers(points: NDArray[Any]) -> tuple[NDArray[np.intp], bool]:
    """Which points belong to the object.

    Args:
        points: [n, 3] metres, on a voxel grid of 3 mm.

    Returns:
        Indices of the points to keep, in increasing order, never none of n > 0; and whether the rule of `NEIGHBORS` was
        left out because it would have dropped more than half of the object, as of a small one or one seen through gaps.
    """
    kept = np.arange(len(points))
    if len(points) == 0:
        return kept, False
    among = _among_others(points)
    relaxed = 2 * int(among.sum()) < len(points)
    if not relaxed:
        kept = kept[among]
    return kept[_in_large_piece(points[kept])], relaxed
