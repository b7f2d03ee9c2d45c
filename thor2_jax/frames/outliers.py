"""Points of an instance: voxel grid and outlier removal (paper, section "Recognition").

A mask extends past the edge of its object, onto the background and onto flying pixels between the two. Four rules
remove these points: steps in depth show flying pixels, pixels at the contour that are far behind others or on the plane
around the mask show strips of background, the mean distance to the neighbours shows stray points, and small pieces that
are separate from the rest are background.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, RGBDFrame

__all__ = ["downsample_to_fit", "fit_plane", "flying_pixels", "remove_outliers", "strip_pixels", "voxel_downsample"]


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
        InputError: the size is too small for the cloud, or points are not finite.
    """
    if len(points) == 0:
        return points.copy(), colors.copy()
    if not np.isfinite(points).all():
        raise InputError("points has rows that are not finite; expected finite coordinates")
    exact = points.T.astype(np.float64, order="C")  # coordinates in contiguous rows, which reductions read faster
    places = np.floor((exact - (exact.min(axis=1, keepdims=True) - size / 2)) / size)
    if not np.prod(places.max(axis=1) + 1) < 2.0**62:
        sides = np.ptp(exact, axis=1).tolist()
        raise InputError(f"size is {size!r}; expected a larger one for a cloud with side lengths {sides}")
    cubes = places.astype(np.int64)
    extent = cubes.max(axis=1) + 1
    cube = _renumbered((cubes[0] * extent[1] + cubes[1]) * extent[2] + cubes[2], math.prod(extent.tolist()))
    counts = np.bincount(cube)

    def mean(planes: NDArray[Any]) -> NDArray[np.float64]:
        return np.stack([np.bincount(cube, weights=plane) / counts for plane in planes], axis=1)

    mean_colors = mean(colors.T)
    if colors.dtype == np.uint8:
        mean_colors = np.floor(mean_colors + 0.5)
    return mean(exact).astype(points.dtype), mean_colors.astype(colors.dtype)


def _renumbered(key: NDArray[np.int64], n_keys: int) -> NDArray[np.intp]:
    """Return the position of each key [n], from 0 to `n_keys` - 1, among the sorted different keys."""
    if n_keys > 64 * len(key):  # sorting is faster, and needs less memory
        return np.unique(key, return_inverse=True)[1]
    occurs, position = np.zeros(n_keys, bool), np.empty(n_keys, np.intp)
    occurs[key] = True
    different = np.flatnonzero(occurs)
    position[different] = np.arange(len(different))
    return position[key]


def downsample_to_fit(
    points: NDArray[np.floating[Any]], colors: NDArray[Any], size: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Call `voxel_downsample` with the size doubled until the cloud fits into the largest bucket."""
    downsampled = voxel_downsample(points, colors, size)
    fits = len(downsampled[0]) <= POINT_BUCKETS[-1]
    return downsampled if fits else downsample_to_fit(points, colors, 2 * size)


MAX_SLOPE = 15.0
"""Steepest slope of a visible surface: change of depth from pixel to pixel, in pixel widths (86 degrees from facing the
camera)."""

MIN_CELL = 6
"""Smallest side length, pixels, of the square cells in which strips of background are searched. In larger images, cells
are a hundredth of the longer side, since masks extend farther past the object."""

STRIP_STEP, STRIP_SLOPE = 0.05, 3.0
"""Smallest distance of background behind the nearest pixel of its cell and the eight adjacent cells: the larger of a
step in metres and a slope over two cells, in pixel widths per pixel (72 degrees from facing the camera)."""

ON_PLANE, LOW, PLANE_SHARE = 0.005, 0.1, 0.3
"""ON_PLANE: largest distance of a table's pixels from its plane, metres. LOW: the same divided by the height of the
object, which is smaller for low objects. PLANE_SHARE: smallest fraction of the background around a mask that lies on
the plane of a table."""

PLANE_MARGIN, PLANE_SAMPLES = 12, 14
"""PLANE_MARGIN: smallest width of the region around a mask in which the table is searched, pixels. PLANE_SAMPLES:
number of its rows and of its columns that are used."""

_CORNERS = np.random.default_rng(0).random((32, 3))
"""Places in a list of points, from 0 to 1: three of them span a plane in `fit_plane`."""

NEIGHBORS = 30
"""Number of neighbours on the voxel grid of 3 mm; on a plane, they lie within 9 mm, at its corners within 19 mm."""

MAX_NEIGHBOR_DISTANCE = 0.016
"""Largest mean distance of a point to its nearest `NEIGHBORS`, metres; at the corner of a plane it is 0.012."""

PIECE_CELL = 0.01
"""Side length of the grid cells that form pieces, metres. Cells that touch, even at a corner, are one piece."""

GRID_REACH = 100
"""Number of cells of that grid on either side of the cloud's median along each axis (1 m), which limits the memory. All
points outside count as one piece."""

MIN_PIECE_SHARE = 0.1
"""Smallest number of points in a kept piece, as a fraction of those in the largest piece."""


def flying_pixels(frame: RGBDFrame, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pixels are flying pixels: farther behind a 4-neighbour of their instance than `MAX_SLOPE` allows.

    Args:
        frame: the frame.
        pixels: [n] flat indices of pixels of one instance.

    Returns:
        [n] bool; False where there is no depth.
    """
    height, width = frame.depth.shape
    labels, depth = frame.label_image.ravel(), frame.depth_m.ravel()
    row, column = np.divmod(pixels, width)
    here, instance = depth[pixels], labels[pixels]
    # A pixel is a flying pixel if a neighbour is closer than this. At the image border, a pixel is its own neighbour.
    nearest = here - MAX_SLOPE / frame.intrinsics.fx * here
    flying = np.zeros(len(pixels), bool)
    right, left, down, up = column < width - 1, column > 0, row < height - 1, row > 0
    for beside in (pixels + right, pixels - left, pixels + width * down, pixels - width * up):
        there = depth[beside]
        flying |= (there < nearest) & (there > 0) & (labels[beside] == instance)
    return flying


def strip_pixels(
    frame: RGBDFrame, pixels: NDArray[np.intp], points: NDArray[np.float64], rim: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which pixels of an instance show the background beside an object, in a mask that is too large.

    Strips of a table beside an object are connected with it where it stands, so they are not separate pieces. Strips
    wider than two cells may remain in part.

    Args:
        frame: the frame.
        pixels: [n] flat indices of pixels of one instance.
        points: [n, 3] their points, metres.
        rim: [n] whether a pixel is near the contour of the mask. Strips begin there. The bottom of a cup is far behind
            its edge, too, but is kept if the edge is wider than the rim.

    Returns:
        [n] bool; False where there is no depth.
    """
    depth = frame.depth_m.ravel()[pixels]
    row, column = np.divmod(pixels.astype(np.int32), frame.depth.shape[1])
    on_table = _on_table(frame, row, column, points)
    side = max(MIN_CELL, max(frame.depth.shape) // 100)
    row, column = row // side, column // side
    row, column = row - row.min(), column - column.min()
    shape = row.max() + 1, column.max() + 1
    cell = row * shape[1] + column
    nearest = np.full(shape, np.inf, depth.dtype)  # equal types make `minimum.at` fast
    valid = np.where((depth >= MIN_DEPTH) & (depth <= MAX_DEPTH), depth, np.inf)
    # Of two successive pixels the farther one counts, so that no single wrong pixel in front makes others background.
    np.minimum.at(nearest.ravel(), cell[1:], np.maximum(valid[1:], valid[:-1]))
    nearest = ndimage.minimum_filter(nearest, 3)
    limit = np.maximum(nearest + STRIP_STEP, nearest * (1 + STRIP_SLOPE * 2 * side / frame.intrinsics.fx))
    strip = (depth > limit.take(cell)) | on_table
    begins = np.bincount(cell[strip & rim], minlength=limit.size).reshape(shape) > 0
    return np.asarray(strip & ndimage.maximum_filter(begins, 3).take(cell))


def _on_table(
    frame: RGBDFrame, row: NDArray[np.int32], column: NDArray[np.int32], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return which pixels [n] of a mask lie on the plane that has the most background around the mask."""

    def around(place: NDArray[np.int32], size: int) -> NDArray[np.intp]:
        margin = max(PLANE_MARGIN, int(np.ptp(place)) // 4)
        low, high = max(place.min() - margin, 0), min(place.max() + margin, size - 1)
        return np.linspace(low, high, PLANE_SAMPLES).astype(np.intp)

    height, width = frame.depth.shape
    beside = np.add.outer(around(row, height) * width, around(column, width)).ravel()
    depth = frame.depth_m.ravel()[beside]
    beside = beside[(frame.label_image.ravel()[beside] == 0) & (depth >= MIN_DEPTH) & (depth <= MAX_DEPTH)]
    normal, offset, share = fit_plane(frame.points(beside), ON_PLANE)
    seen = points[:, 2] > 0
    if share < PLANE_SHARE or not seen.any():
        return np.zeros(len(points), bool)
    heights = np.abs(points @ normal - offset)
    top = np.sort(heights[seen][::8])
    return np.asarray(heights < min(ON_PLANE, LOW * top[len(top) * 19 // 20]))  # higher points may be flying pixels


def fit_plane(points: NDArray[np.floating[Any]], tolerance: float) -> tuple[NDArray[np.float64], float, float]:
    """Find the plane that most points [n, 3] lie on, by RANSAC; equal points have equal planes.

    Returns:
        The unit normal [3] and the offset of the plane, which is the product of the normal and any of its points, and
        the fraction of the points that lie on the plane. If no three points span a plane, these are zero, infinity and
        zero, so that no point lies on it.
    """
    nothing = np.zeros(3), math.inf, 0.0
    if len(points) == 0:
        return nothing
    corners = points[(_CORNERS * len(points)).astype(np.intp)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    distances = np.abs(points @ normals.T - (normals * corners[:, 0]).sum(axis=1))  # times the lengths of the normals
    is_near = distances < tolerance * np.linalg.norm(normals, axis=1)
    inliers = points[is_near[:, is_near.sum(axis=0).argmax()]]
    if len(inliers) == 0:
        return nothing
    center = inliers.mean(axis=0)
    normal = np.linalg.eigh((inliers - center).T @ (inliers - center))[1][:, 0]
    return normal, float(normal @ center), len(inliers) / len(points)


def _grid(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """Return the flat cell index [n] of each of `points` [3, n] and the shape of the grid.

    Points beyond `GRID_REACH` get index 0. Two layers of cells on every side are empty, so that no other cell touches
    cell 0.
    """
    place = np.floor(points / PIECE_CELL)
    near = None
    if np.ptp(place, axis=1).max() > GRID_REACH:
        place -= np.floor(np.median(place, axis=1, keepdims=True))
        near = (np.abs(place) <= GRID_REACH).all(axis=0)
        place = np.where(near, place, 0)
    cells = (place - place.min(axis=1, keepdims=True)).astype(np.int64) + 2
    shape = tuple((cells.max(axis=1) + 3).tolist())
    flat = np.ravel_multi_index(tuple(cells), shape)
    return flat if near is None else np.where(near, flat, 0), shape


def _surrounded(points: NDArray[np.float64], cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return which of `points` [3, n] certainly pass the neighbour rule, from counts and moments of grid cells.

    If more than `NEIGHBORS` points lie in a point's cell and the adjacent cells, the mean distance to the nearest of
    them is at most the root mean square distance to all of them.
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
    return np.asarray((others >= NEIGHBORS) & (total <= others * MAX_NEIGHBOR_DISTANCE**2))


def _among_others(points: NDArray[np.float64], cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    among = _surrounded(points, cell, shape)
    rest = np.flatnonzero(~among)
    if len(rest):
        from scipy.spatial import KDTree  # importing it takes 0.1 s, and rendering does not need it

        tree = KDTree(points.T, leafsize=32, balanced_tree=False, compact_nodes=False)  # quick to build
        distances = tree.query(points[:, rest].T, k=NEIGHBORS + 1)[0][:, 1:]
        among[rest] = distances.mean(axis=1) <= MAX_NEIGHBOR_DISTANCE
    return among


def _in_large_piece(cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    full = np.zeros(shape, bool)
    full.ravel()[cell[cell > 0]] = True
    pieces, _ = ndimage.label(full, structure=np.ones((3, 3, 3)))
    piece = pieces.ravel()[cell]
    size = np.bincount(piece)
    return np.asarray(size[piece] >= MIN_PIECE_SHARE * size.max())


def remove_outliers(points: NDArray[Any]) -> tuple[NDArray[np.intp], bool]:
    """Return which points belong to the object.

    Args:
        points: [n, 3] metres, on a voxel grid of 3 mm.

    Returns:
        Indices of the points to keep, in increasing order, at least one if n > 0; and whether the neighbour rule was
        skipped because it would have dropped more than half of the object, as if it is small or seen through gaps.
    """
    if len(points) == 0:
        return np.arange(0), False
    planes = points.T.astype(np.float64, order="C")
    cell, shape = _grid(planes)
    among = _among_others(planes, cell, shape)
    relaxed = 2 * int(among.sum()) < len(points)
    kept = np.flatnonzero(among | relaxed)
    return kept[_in_large_piece(cell[kept], shape)], relaxed
