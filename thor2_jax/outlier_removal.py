"""Outlier removal on the cloud of one instance (paper, section "Recognition"): what a depth camera adds to an object.

A mask reaches past its object's edge, where pixels "fly" between it and what lies behind. Three filters, each for one kind:
points with few others around, points farther from their neighbours than is usual in this cloud, and pieces apart from the rest.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

__all__ = ["remove_outliers"]

RADIUS = 0.05
"""Metres around a point within which its neighbours are counted."""

MIN_NEIGHBORS = 220
"""Neighbours a point needs within `RADIUS`, at a voxel of 3 mm."""

REFERENCE_VOXEL = 0.003
"""Voxel side in metres for which `MIN_NEIGHBORS` holds. Points lie on a surface: the count goes with 1 / side squared."""

NEIGHBORS = 30
DEVIATIONS = 1.5
"""A point is far when its mean distance to `NEIGHBORS` others exceeds the cloud's mean by this many standard deviations."""

GAP = 4.0
"""Pieces are apart when no two of their points are within this many voxels."""

MIN_SHARE = 0.1
"""Pieces with a smaller share of the largest piece's points are dropped."""


def _crowded(points: NDArray[Any], voxel: float) -> NDArray[np.bool_]:
    around = np.asarray(KDTree(points).query_ball_point(points, RADIUS, return_length=True)) - 1
    return np.asarray(around >= MIN_NEIGHBORS * (REFERENCE_VOXEL / voxel) ** 2)


def _near_neighbors(points: NDArray[Any]) -> NDArray[np.bool_]:
    if len(points) <= NEIGHBORS:
        return np.ones(len(points), bool)
    distance = KDTree(points).query(points, k=NEIGHBORS + 1)[0][:, 1:].mean(axis=1)
    return np.asarray(distance <= distance.mean() + DEVIATIONS * distance.std())


def _in_large_piece(points: NDArray[Any], gap: float) -> NDArray[np.bool_]:
    i, j = KDTree(points).query_pairs(gap, output_type="ndarray").T
    graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(points), len(points)))
    piece = connected_components(graph, directed=False)[1]
    size = np.bincount(piece)
    return np.asarray(size[piece] >= MIN_SHARE * size.max())


def remove_outliers(points: NDArray[Any], voxel: float) -> tuple[NDArray[np.intp], bool]:
    """Which points belong to the object.

    Args:
        points: [n, 3] metres, on a voxel grid.
        voxel: side of its cubes, metres.

    Returns:
        Indices of the points to keep, in increasing order, never none of n > 0; and whether the rule of `MIN_NEIGHBORS` was
        left out because it would have dropped more than half of the object, as of a thin or small one.
    """
    kept = np.arange(len(points))
    if len(points) == 0:
        return kept, False
    crowded = _crowded(points, voxel)
    relaxed = 2 * int(crowded.sum()) < len(points)
    if not relaxed:
        kept = kept[crowded]
    kept = kept[_near_neighbors(points[kept])]
    return kept[_in_large_piece(points[kept], GAP * voxel)], relaxed
