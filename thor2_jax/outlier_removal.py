"""Outlier removal on the cloud of one instance (paper, section "Recognition"): what a depth camera adds to an object.

A mask reaches past its object's edge, where pixels "fly" between it and what lies behind. Three rules, each for one
kind: points with few others around them, points farther from their neighbours than is usual in this cloud, and small
pieces apart from the rest.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

__all__ = ["remove_outliers"]

RADIUS = 0.05
"""Metres around a point within which it needs `NEIGHBORS` others."""

NEIGHBORS = 30
"""On a voxel grid of 3 mm. The count goes with 1 / side squared: points lie on a surface."""

DEVIATIONS = 1.75
"""A point is far when its mean distance to `NEIGHBORS` others is this many standard deviations above the cloud's."""

GAP = 0.02
"""Metres between pieces: no two of their points are nearer."""

MIN_SHARE = 0.1
"""Pieces with a smaller share of the largest piece's points are dropped."""


def _in_large_piece(points: NDArray[Any]) -> NDArray[np.bool_]:
    i, j = KDTree(points).query_pairs(GAP, output_type="ndarray").T
    graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(points), len(points)))
    piece = connected_components(graph, directed=False)[1]
    size = np.bincount(piece)
    return np.asarray(size[piece] >= MIN_SHARE * size.max())


def remove_outliers(points: NDArray[Any]) -> tuple[NDArray[np.intp], bool]:
    """Which points belong to the object.

    Args:
        points: [n, 3] metres, on a voxel grid of 3 mm.

    Returns:
        Indices of the points to keep, in increasing order, never none of n > 0; and whether the rule of `RADIUS` was
        left out because it would have dropped more than half of the object, as of one seen through gaps.
    """
    kept = np.arange(len(points))
    if len(points) == 0:
        return kept, False
    relaxed = False
    if len(points) > NEIGHBORS:
        distances = KDTree(points).query(points, k=NEIGHBORS + 1)[0][:, 1:]
        crowded = distances[:, -1] <= RADIUS
        relaxed = 2 * int(crowded.sum()) < len(points)
        if not relaxed:
            kept, distances = kept[crowded], distances[crowded]
        mean = distances.mean(axis=1)
        kept = kept[mean <= mean.mean() + DEVIATIONS * mean.std()]
    return kept[_in_large_piece(points[kept])], relaxed
