"""One coloured point cloud for each instance of a frame (paper, section "Recognition").

Pixels with valid depth are put on a voxel grid of 3 mm, which replaces the points of each voxel by their mean, as
Open3D's `voxel_down_sample` does. A mask extends past the edge of its object, onto the background and onto flying
pixels between the two. Three rules remove them: flying pixels are found by steps in depth, stray points by the mean
distance to their neighbours, and background by small pieces that are apart from the rest. An instance that cannot be
used is not dropped: its `reason` says why.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, RGBDFrame, pixel_points

__all__ = [
    "EMPTY_INSTANCE",
    "MIN_POINTS",
    "PreparedInstance",
    "downsample_to_fit",
    "flying_pixels",
    "instance_cloud",
    "instance_clouds",
    "remove_outliers",
    "unit_question",
    "voxel_downsample",
]


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
    fits = len(downsampled[0]) <= POINT_BUCKETS[-1]
    return downsampled if fits else downsample_to_fit(points, colors, 2 * size)


MAX_SLOPE = 15.0
"""Steepest slope of a visible surface: change of depth from pixel to pixel, in pixel widths (86 degrees from facing the
camera)."""

NEIGHBORS = 30
"""Neighbours of a point on the voxel grid of 3 mm; on a plane, they lie within 9 mm, at its corners within 19 mm."""

MAX_NEIGHBOR_DISTANCE = 0.016
"""Largest mean distance of a point to its nearest `NEIGHBORS`, metres; at the corner of a plane it is 0.012."""

PIECE_CELL = 0.01
"""Cell side of the grid that finds pieces, metres. Cells that touch, even at a corner, are one piece."""

GRID_REACH = 100
"""Cells of that grid on either side of the cloud's median along each axis (1 m), which bounds its memory. All points
outside count as one piece."""

MIN_PIECE_SHARE = 0.1
"""Least size of a piece that is kept, as a share of the points of the largest piece."""


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


def _grid(points: NDArray[np.float64]) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """Return the flat cell index [n] of each of `points` [3, n] and the shape of the grid.

    Points past `GRID_REACH` get index 0. Two layers of cells on every side are empty, so that no other cell touches
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
    """Return which of `points` [3, n] surely pass the neighbour rule, from counts and moments of grid cells.

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
    return np.asarray((others >= NEIGHBORS) & (total <= others * MAX_NEIGHBOR_DISTANCE**2))


def _among_others(points: NDArray[np.float64], cell: NDArray[np.int64], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    n_points = points.shape[1]
    if n_points <= NEIGHBORS:
        return np.zeros(n_points, bool)
    among = _surrounded(points, cell, shape)
    rest = np.flatnonzero(~among)
    if len(rest):
        from scipy.spatial import KDTree  # takes .1 s to import, and rendering needs none

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


CLOUD_VOXEL = 0.003
"""Voxel side of the grid on which outliers are removed, metres."""

RIM = 2
"""Width of the rim of a mask, pixels: masks reach over the edges of their objects."""

MIN_POINTS = 30
"""Least number of points on that grid; an instance with fewer cannot be used."""


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedInstance:
    """The cloud of an instance of a frame; one of `prepare_instance` is on the descriptors' voxel grid.

    Attributes:
        label: its number in the label image.
        points: [n, 3] float32, metres, OpenCV camera frame; empty if the instance cannot be used.
        colors: [n, 3] uint8, sRGB.
        boundary: [n] bool, points on the occlusion boundary; all False if the instance is not occluded.
        occluded: another instance hides a part of it, or the image border cuts it.
        kept_by_fallback: a rule of outlier removal would have dropped most of it and was skipped.
        reason: why the instance cannot be used; None if it can.
        rim: [n] bool, points of pixels within `RIM` of the contour of the mask, if less than half of them are; None
            without a mask.
    """

    label: int
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    boundary: NDArray[np.bool_]
    occluded: bool = False
    kept_by_fallback: bool = False
    reason: str | None = None
    rim: NDArray[np.bool_] | None = None


EMPTY_INSTANCE = PreparedInstance(0, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool))
"""An instance without points, which pads a batch."""


def instance_clouds(frame: RGBDFrame) -> list[PreparedInstance]:
    """Return the clouds of all instances in the order of `frame.instances`, including those that cannot be used."""
    return [instance_cloud(frame, label) for label in frame.instances]


def instance_cloud(frame: RGBDFrame, label: int, with_rim: bool = True) -> PreparedInstance:
    """Return the cloud of one instance, on a voxel grid of 3 mm and before `find_occlusion`.

    Args:
        frame: the frame.
        label: one of `frame.instances`.
        with_rim: whether to find the rim.
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
    channels = frame.color.reshape(-1, 3).take(valid, axis=0)
    if with_rim:  # as a further colour channel
        channels = np.column_stack([channels, _near_contour(frame, label, pixels)[trusted] * np.uint8(255)])
    points, channels = voxel_downsample(points, channels, CLOUD_VOXEL)
    if len(points) < MIN_POINTS:
        reason = (
            f"{len(points)} points ({len(pixels)} pixels, {len(valid)} of them with depth "
            f"from {MIN_DEPTH} to {MAX_DEPTH} m); expected at least {MIN_POINTS}"
        )
        if not frame.has_usable_depth:
            reason += f"; no instance has such depth: {unit_question(frame)}"
        return dataclasses.replace(EMPTY_INSTANCE, label=label, reason=reason)
    kept, relaxed = remove_outliers(points)
    points, channels, none = points.take(kept, axis=0), channels.take(kept, axis=0), np.zeros(len(kept), bool)
    rim = channels[:, 3] > 127 if with_rim else None
    return PreparedInstance(label, points, channels[:, :3], none, False, steep or relaxed, rim=rim)


def _near_contour(frame: RGBDFrame, label: int, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pixels [n] of a mask are within `RIM` of one that is not in it; the image border is no contour."""
    (first, last), column = pixels[[0, -1]] // frame.depth.shape[1], pixels % frame.depth.shape[1]
    columns = slice(max(column.min() - RIM, 0), column.max() + RIM + 1)
    window = frame.label_image[max(first - RIM, 0) : last + RIM + 1, columns] == label
    # As `scipy.ndimage.minimum_filter`, in half of the time.
    padded, (height, width) = np.pad(window, RIM, mode="edge"), window.shape
    inside = np.logical_and.reduce([padded[k : k + height] for k in range(2 * RIM + 1)])
    inside = np.logical_and.reduce([inside[:, k : k + width] for k in range(2 * RIM + 1)])
    return ~inside[window]


def unit_question(frame: RGBDFrame) -> str:
    """Ask whether the unit of a frame's depth is right."""
    if frame.depth.dtype.kind == "f":
        return "is depth, in floating point, in metres?"
    return f"is depth_scale right? It is {frame.intrinsics.depth_scale:g} units per metre"
