"""Outlier removal on one instance (paper, section "Recognition"): what a depth camera and a mask add to an object.

A mask reaches past its object's edge, onto the background and onto pixels that "fly" between the two. Three rules:
pixels at a step in depth fly; points with too few others around them are strays; small pieces apart from the rest are
background.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from thor2_jax.recognition.frames import RGBDFrame

__all__ = ["flying_pixels", "remove_outliers"]

STEEPEST = 15.0
"""Steepest depth, in pixel widths a pixel, that a surface is seen at (86 degrees from facing the camera)."""

NEIGHBORS = 30
"""On a voxel grid of 3 mm. On a plane so many lie within 9 mm, at its corners within 19 mm."""

FARTHEST = 0.016
"""Metres: largest mean distance of a point to its `NEIGHBORS` nearest others. At the corner of a plane it is 12 mm."""

CELL = 0.01
"""Metres: side of the cells of grids. Those that touch, also at a corner, are one piece."""

REACH = 100
"""Cells from the middle of the cloud, along each axis, that a grid has at most; a point past them is in none. So grids
stay small. These are 1 m, and all that lies farther counts as one piece."""

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
    here, instance = depth[pixels], labels[pixels]
    # Nearer than this beside a pixel, and it flies; at 0 there is no depth. Past the image, a pixel is beside itself.
    nearest = here - STEEPEST / frame.intrinsics.fx * here
    flying = np.zeros(len(pixels), bool)
    for beside in (
        pixels + (column < width - 1),
        pixels - (column > 0),
        pixels + width * (row < height - 1),
        pixels - width * (row > 0),
    ):
        there = depth[beside]
        flying |= (there < nearest) & (there > 0) & (labels[beside] == instance)
    return flying


def _grid(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """Place [n] of each of `points` [3, n] on a flat grid of `CELL`s, and its shape; 0 for points past `REACH`.

    Two layers of cells on every side are empty, so that no cell touches the first.
    """
    place = np.floor(points / CELL)
    near = None
    if np.ptp(place, axis=1).max() > REACH:
        place -= np.floor(np.median(place, axis=1, keepdims=True))
        near = (np.abs(place) <= REACH).all(axis=0)
        place = np.where(near, place, 0)
    cells = (place - place.min(axis=1, keepdims=True)).astype(np.int64) + 2
    shape = tuple((cells.max(axis=1) + 3).tolist())
    flat = np.ravel_multi_index(tuple(cells), shape)
    return flat if near is None else np.where(near, flat, 0), shape


def _surrounded(points: NDArray[np.float64], cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Which of `points` [3, n] are sure to be among others, by the number and the moments of the points in cells.

    Where more than `NEIGHBORS` points lie in a point's cell and those that it touches, the mean distance to the nearest
    of them is at most the root of the mean square distance to all of them.
    """
    points = points - points.mean(axis=1, keepdims=True)
    square = (points**2).sum(axis=0)
    sums = np.stack([np.bincount(cell, weights=w, minlength=math.prod(shape)) for w in (None, *points, square)])
    sums[:, 0] = 0
    for step in (1, shape[2], shape[1] * shape[2]):
        row = sums.copy()
        row[:, step:] += sums[:, :-step]
        row[:, :-step] += sums[:, step:]
        sums = row
    count, x, y, z, squares = sums[:, cell]
    total = squares - 2 * (points * (x, y, z)).sum(axis=0) + count * square
    others = count - 1
    return np.asarray((others >= NEIGHBORS) & (total <= others * FARTHEST**2))


def _among_others(points: NDArray[np.float64], cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    n_points = points.shape[1]
    if n_points <= NEIGHBORS:
        return np.zeros(n_points, bool)
    among = _surrounded(points, cell, shape)
    rest = np.flatnonzero(~among)
    if len(rest):
        tree = KDTree(points.T, leafsize=32, balanced_tree=False, compact_nodes=False)  # quick to build
        distances = tree.query(points[:, rest].T, k=NEIGHBORS + 1)[0][:, 1:]
        among[rest] = distances.mean(axis=1) <= FARTHEST
    return among


def _in_large_piece(cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    full = np.zeros(shape, bool)
    full.ravel()[cell[cell > 0]] = True
    pieces, _ = ndimage.label(full, structure=np.ones((3, 3, 3)))
    piece = pieces.ravel()[cell]
    size = np.bincount(piece)
    return np.asarray(size[piece] >= MIN_SHARE * size.max())


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
    planes = points.T.astype(np.float64, order="C")
    cell, shape = _grid(planes)
    among = _among_others(planes, cell, shape)
    relaxed = 2 * int(among.sum()) < len(points)
    if not relaxed:
        kept = kept[among]
    return kept[_in_large_piece(cell[kept], shape)], relaxed
