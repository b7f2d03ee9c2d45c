"""Prepared instances: the clouds of a frame's instances and their occlusion, computed on the host.

Preparation is pure NumPy and its results can be pickled, so it can run in other processes than the recognizer.

Points of pixels with valid depth are averaged in voxels of 3 mm, as by Open3D's `voxel_down_sample`, and outliers are
removed. An instance that cannot be used is not dropped: its `reason` explains why.

A pixel on the contour of an instance's mask belongs to the occlusion boundary (paper, section "Recognition") if its
neighbour belongs to another instance that is nearer to the camera, or lies outside the image. Masks leave gaps between
objects and depth cameras give no depth along edges, so both depths are searched for within a few pixels of the contour.

An occluded object is recognized like any other. Its boundary points only decide the orientation of its cloud: view
normalization turns it so that the occluded end does not come first along x. `Recognition.occluded` reports occlusion.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, RGBDFrame, check_frame, pixel_rays
from thor2_jax.frames.intrinsics import distort
from thor2_jax.frames.outliers import downsample_to_fit, flying_pixels, remove_outliers, strip_pixels, voxel_downsample
from thor2_jax.printable import first_names

if TYPE_CHECKING:
    from thor2_jax.types import PointClouds

__all__ = [
    "DESCRIPTOR_VOXEL",
    "EMPTY_INSTANCE",
    "MIN_POINTS",
    "PreparedInstance",
    "instance_view",
    "pack_instances",
    "prepare_instance",
    "unit_question",
]

CLOUD_VOXEL = 0.003
"""Side length of a voxel in the grid on which outliers are removed, metres."""

RIM = 2
"""Width of the rim of a mask, pixels, where the mask may extend past the object."""

MIN_POINTS = 30
"""Smallest number of points on that grid; an instance with fewer cannot be used."""


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedInstance:
    """The cloud of an instance of a frame; `prepare_instance` returns it on the descriptors' voxel grid.

    Attributes:
        label: number of the instance in the label image.
        points: [n, 3] float32, metres, OpenCV camera frame; empty if the instance cannot be used.
        colors: [n, 3] uint8, sRGB.
        boundary: [n] bool, points on the occlusion boundary; all False if the instance is not occluded.
        occluded: whether another instance hides a part of the instance, or the image border cuts it.
        kept_by_fallback: whether an outlier rule was skipped, since it would have dropped most of the cloud.
        reason: why the instance cannot be used; None if it can be used.
        rim: [n] bool, points of pixels within `RIM` of the contour of the mask; all False if more than half of the
            points are; None without a mask.
        around: [AROUND, AROUND, 3] float32, see `PointClouds.around`; None if it is unknown.
    """

    label: int
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    boundary: NDArray[np.bool_]
    occluded: bool = False
    kept_by_fallback: bool = False
    reason: str | None = None
    rim: NDArray[np.bool_] | None = None
    around: NDArray[np.float32] | None = None


EMPTY_INSTANCE = PreparedInstance(0, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool))
"""An instance without points, which pads a batch."""


def instance_cloud(frame: RGBDFrame, label: int) -> PreparedInstance:
    """Return the cloud of one instance, on a voxel grid of 3 mm and before `find_occlusion`.

    Args:
        frame: the frame.
        label: one of `frame.instances`.

    Raises:
        InputError: the frame has no such instance, or the points are too far apart for the grid, for example because of
            wrong intrinsics.
    """
    if label not in frame.instances:
        listed = first_names(list(map(str, frame.instances)), 10)
        expected = f"one of {listed}" if listed else "a frame with instances"
        raise InputError(f"instance is {label!r}; expected {expected}")
    pixels = frame.instance_pixels[label]
    depth, exact = frame.depth_m.ravel()[pixels], frame.points(pixels)
    trusted = (depth >= MIN_DEPTH) & (depth <= MAX_DEPTH)
    rim = _near_contour(frame, label, pixels)  # becomes a further colour channel
    skipped = False
    for background in (flying_pixels(frame, pixels), strip_pixels(frame, pixels, exact, rim)):
        rest = trusted & ~background
        if 2 * int(rest.sum()) < int(trusted.sum()):
            skipped = True
        else:
            trusted = rest
    valid = pixels[trusted]
    points = exact[trusted].astype(np.float32)
    channels = np.column_stack([frame.color.reshape(-1, 3).take(valid, axis=0), rim[trusted] * np.uint8(255)])
    try:
        points, channels = voxel_downsample(points, channels, CLOUD_VOXEL)
    except InputError:
        raise InputError(
            "intrinsics place the points of an instance too far apart; check fx, fy and depth_scale"
        ) from None
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
    return PreparedInstance(label, points, channels[:, :3], none, False, skipped or relaxed, rim=channels[:, 3] > 127)


def _near_contour(frame: RGBDFrame, label: int, pixels: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pixels [n] of a mask are within `RIM` of a pixel outside it; the image border is no contour."""
    (first, last), column = pixels[[0, -1]] // frame.depth.shape[1], pixels % frame.depth.shape[1]
    columns = slice(max(column.min() - RIM, 0), column.max() + RIM + 1)
    window = frame.label_image[max(first - RIM, 0) : last + RIM + 1, columns] == label
    # This equals `scipy.ndimage.minimum_filter`, in less than half the time.
    (height, width), padded = window.shape, np.ones(np.add(window.shape, 2 * RIM), bool)
    padded[RIM:-RIM, RIM:-RIM] = window
    inside = np.logical_and.reduce([padded[k : k + height] for k in range(2 * RIM + 1)])
    inside = np.logical_and.reduce([inside[:, k : k + width] for k in range(2 * RIM + 1)])
    return ~inside[window]


def unit_question(frame: RGBDFrame) -> str:
    """Ask whether the unit of a frame's depth is right, or why it has none."""
    if not (frame.depth_m > 0).any():
        return "no pixel has depth: is the depth image of this frame, and does the camera deliver depth?"
    if frame.depth.dtype.kind == "f":
        return "is depth, in floating point, in metres?"
    return f"is depth_scale right? It is {frame.intrinsics.depth_scale:g} units per metre"


STEPS = 6
"""Number of pixels on either side of the contour that are searched for valid depth."""

GAP = 3
"""Largest number of background pixels between two masks that count as neighbours."""

MARGIN = max(STEPS, GAP + 1)
"""Width of the searched margin around the mask, pixels."""

NEARER = 0.01
"""Smallest distance, metres, by which the other instance must be nearer; noise between touching objects is smaller."""

MIN_BOUNDARY_SHARE = 0.05
"""Smallest fraction of the contour that is occlusion boundary in an occluded instance; noise causes a smaller one."""

BACKGROUND, OUTSIDE = 0, -1
"""Values in place of a label: no instance, and outside the image."""

BOUNDARY_REACH = 0.012
"""Largest distance in metres from a boundary pixel's point to the point of the cloud that it marks."""


def find_occlusion(frame: RGBDFrame, cloud: PreparedInstance) -> tuple[bool, NDArray[np.bool_]]:
    """Find the occlusion boundary of one instance.

    Args:
        frame: the frame.
        cloud: the instance's cloud, from `instance_cloud`.

    Returns:
        Whether the instance is occluded (see `PreparedInstance`), and [n] bool, the points of the cloud on the
        boundary; all False if it is not occluded.
    """
    pixels = frame.instance_pixels[cloud.label]
    on_contour, on_boundary, own_depth = _contour(frame, cloud.label, pixels)
    boundary = np.zeros(len(cloud.points), bool)
    occluded = bool(on_boundary.sum() >= MIN_BOUNDARY_SHARE * on_contour.sum())
    seen = on_boundary & (own_depth > 0)
    if occluded:
        edge = pixel_rays(pixels[seen], frame.depth.shape[1], frame.intrinsics) * own_depth[seen, None]
        distance, nearest = KDTree(cloud.points, leafsize=32, balanced_tree=False, compact_nodes=False).query(edge)
        boundary[nearest[distance <= BOUNDARY_REACH]] = True
    return occluded, boundary


def _window(
    frame: RGBDFrame, pixels: NDArray[np.intp]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.intp]]:
    """Return labels and depth in a window around a mask (with `MARGIN`), and the mask's flat indices in it."""
    height, width = frame.depth.shape
    row, column = np.divmod(pixels, width)
    top, left = row.min() - MARGIN, column.min() - MARGIN
    shape = row.max() - top + MARGIN + 1, column.max() - left + MARGIN + 1
    inside = slice(max(top, 0), min(top + shape[0], height)), slice(max(left, 0), min(left + shape[1], width))
    here = tuple(slice(part.start - first, part.stop - first) for part, first in zip(inside, (top, left), strict=True))
    labels, depth = np.full(shape, OUTSIDE, np.int64), np.zeros(shape, np.float32)
    labels[here], depth[here] = frame.label_image[inside], frame.depth_m[inside]
    return labels, depth, (row - top) * shape[1] + column - left


def _contour(
    frame: RGBDFrame, label: int, pixels: NDArray[np.intp]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float32]]:
    """Return whether each pixel of the mask is on the contour and on the occlusion boundary, and the object's depth."""
    window, depth, places = _window(frame, pixels)
    labels, depth = window.ravel(), depth.ravel()
    steps = (1, -1, window.shape[1], -window.shape[1])
    edges = [np.flatnonzero(labels[places + step] != label) for step in steps]
    edge, step = np.concatenate(edges), np.repeat(steps, [len(indices) for indices in edges])
    here = places[edge]

    def first_depth(start: NDArray[np.intp], step: NDArray[np.intp], wanted: Any) -> NDArray[np.float32]:
        """Return the first valid depth of an instance along each step; 0 if there is none within `STEPS` pixels."""
        at = start + step * np.arange(STEPS)[:, None]
        usable = (labels[at] == wanted) & (depth[at] > 0)
        first = at[usable.argmax(axis=0), np.arange(len(start))]
        return np.where(usable.any(axis=0), depth[first], 0)

    own = first_depth(here, -step, label)
    beside = labels[here + step]
    other = beside
    for k in range(2, GAP + 2):
        other = np.where(other == BACKGROUND, labels[here + k * step], other)
    theirs = np.where(other > BACKGROUND, first_depth(here + step, step, other), 0)
    hides = (other != label) & (theirs > 0) & (theirs < own - NEARER)

    on_contour, on_boundary = np.zeros(len(pixels), bool), np.zeros(len(pixels), bool)
    own_depth = np.zeros(len(pixels), np.float32)
    on_contour[edge] = True
    on_boundary[edge[hides | (beside == OUTSIDE)]] = True
    own_depth[edge[own > 0]] = own[own > 0]
    return on_contour, on_boundary, own_depth


DESCRIPTOR_VOXEL = 0.01
"""Voxel side, in scaled units, of all described clouds, also in training, since colour vectors count points."""


def prepare_instance(frame: RGBDFrame, label: int, sigma_s: float) -> PreparedInstance:
    """Compute the cloud of one instance and its occlusion boundary, on the descriptors' voxel grid.

    Args:
        frame: the frame.
        label: one of `frame.instances`.
        sigma_s: scaled units per metre, see `DescriptorConfig`.

    Raises:
        InputError: as `instance_cloud`.
    """
    cloud = instance_cloud(frame, label)
    if cloud.reason is not None:
        return cloud
    occluded, boundary = find_occlusion(frame, cloud)
    # Flags are further colour channels: a voxel is on the boundary if any of its points is, on the rim if most are.
    flags = np.array([boundary, cloud.rim]).T
    channels = np.column_stack([cloud.colors, flags * np.uint8(255)])
    points, channels = downsample_to_fit(cloud.points, channels, DESCRIPTOR_VOXEL / sigma_s)
    colors, boundary, rim = channels[:, :3], channels[:, 3] > 0, channels[:, 4] > 127
    if 2 * rim.sum() > len(rim):  # a narrow object would lose most of its points
        rim[:] = False
    around = _around(frame, label)
    return PreparedInstance(label, points, colors, boundary, occluded, cloud.kept_by_fallback, rim=rim, around=around)


AROUND = 24
"""Number of rows and of columns of the rays around an instance."""

FARTHEST = 10.0
"""Largest depth of a background, metres; larger values are errors of the camera."""


def _around(frame: RGBDFrame, label: int) -> NDArray[np.float32]:
    """Return `PointClouds.around` for an instance: rays in its box, which is enlarged by a quarter on each side."""
    (height, width), camera = frame.depth.shape, frame.intrinsics
    row, column = np.divmod(frame.instance_pixels[label], width)

    def enlarged(low: int, high: int, size: int) -> NDArray[np.intp]:
        margin = (high - low) // 4 + 2 * RIM
        return np.array([max(low - margin, RIM), min(high + margin, size - 1 - RIM)])

    corners = enlarged(row[0], row[-1], height) * width + enlarged(column.min(), column.max(), width)
    low, high = pixel_rays(corners, width, camera)
    x, y, _ = np.linspace(low, high, AROUND).T
    around = np.zeros((AROUND, AROUND, 3), np.float32)
    around[..., 0], around[..., 1] = x, y[:, None]
    u, v = around[..., 0], around[..., 1]
    if camera.distortion:
        u, v = distort(u, v, camera.distortion)
    columns, rows = np.rint(u * camera.fx + camera.cx), np.rint(v * camera.fy + camera.cy)
    inside = (rows >= RIM) & (rows < height - RIM) & (columns >= RIM) & (columns < width - RIM)
    pixels = np.where(inside, rows * width + columns, 0).astype(np.intp)
    depth, labels = frame.depth_m.ravel().take(pixels), frame.label_image.ravel()
    seen = inside & (depth >= MIN_DEPTH) & (depth <= FARTHEST)
    for step in itertools.product((-RIM, 0, RIM), repeat=2):  # masks may be too small
        seen &= labels.take(pixels + (step[0] * width + step[1]), mode="clip") != label
    around[..., 2] = np.where(seen, depth, 0)
    return around


def instance_view(frame: RGBDFrame, label: int | None, sigma_s: float) -> PreparedInstance:
    """Prepare one instance of a frame for enrollment or explanation.

    Args:
        frame: the frame.
        label: number of the instance; None for the only instance of the frame.
        sigma_s: scaled units per metre, see `DescriptorConfig`.

    Raises:
        InputError: the frame has no such instance, it has several and `label` is None, or the instance cannot be used.
    """
    check_frame(frame)
    if label is None and len(frame.instances) != 1:
        raise InputError(f"labels has {len(frame.instances)} instances; expected one, or give the object's number")
    view = prepare_instance(frame, frame.instances[0] if label is None else label, sigma_s)
    if view.reason is not None:
        raise InputError(f"instance {view.label} cannot be used: {view.reason}")
    return view


def pack_instances(instances: Sequence[PreparedInstance], n_rows: int, capacity: int | None = None) -> "PointClouds":
    """Pack instances as a batch of `n_rows` clouds in host memory; the last ones are empty.

    Args:
        instances: at most `n_rows` instances.
        n_rows: B, number of clouds in the batch.
        capacity: N, padded number of points; by default the bucket of the largest cloud, see `PointClouds.pack`.
    """
    from thor2_jax.types import PointClouds  # imports JAX, which preparation does not need

    padded = [*instances, *[EMPTY_INSTANCE] * (n_rows - len(instances))]
    clouds = [(instance.points, instance.colors) for instance in padded]
    boundary, rim = [instance.boundary for instance in padded], [instance.rim for instance in padded]
    nothing = np.zeros((AROUND, AROUND, 3), np.float32)
    around: Any = np.stack([nothing if instance.around is None else instance.around for instance in padded])
    packed = PointClouds.pack(clouds, capacity, boundary=boundary, rim=rim, on_host=True)
    return dataclasses.replace(packed, around=around)
