"""Prepared instances: the clouds of a frame's instances and their occlusion, computed on the host.

Preparation is pure NumPy and its results can be pickled, so it can run in other processes than the recognizer.

A pixel on the contour of an instance's mask belongs to the occlusion boundary (paper, section "Recognition") if its
neighbour belongs to another instance that is nearer to the camera, or lies outside the image. Masks leave gaps between
objects and depth cameras give no depth along edges, so both depths are searched for within a few pixels of the contour.

An occluded object is recognized like any other. Its boundary points only decide the orientation of its cloud: view
normalization turns it so that the occluded end does not come first along x. `Recognition.occluded` reports it.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thor2_jax.frames.frames import RGBDFrame, pixel_rays
from thor2_jax.frames.instance_clouds import EMPTY_INSTANCE, PreparedInstance, downsample_to_fit, instance_cloud

if TYPE_CHECKING:
    from thor2_jax.types import PointClouds

__all__ = [
    "DESCRIPTOR_VOXEL",
    "EMPTY_INSTANCE",
    "PreparedInstance",
    "find_occlusion",
    "pack_instances",
    "prepare_instance",
]

STEPS = 6
"""Pixels on either side of the contour that are searched for valid depth."""

GAP = 3
"""Largest number of background pixels between two masks that count as neighbours."""

MARGIN = max(STEPS, GAP + 1)
"""Pixels around the mask that are searched at all."""

NEARER = 0.01
"""Metres by which the other instance must be nearer; depth noise between two touching objects is less."""

MIN_BOUNDARY_SHARE = 0.05
"""Least share of the contour that is occlusion boundary in an occluded instance; noise makes less."""

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
        Whether another instance hides a part of it or the image border cuts it, and [n] bool, the points of the cloud
        on the boundary; all False if it is not occluded.
    """
    pixels = frame.instance_pixels[cloud.label]
    on_contour, on_boundary, own_depth = _contour(frame, cloud.label, pixels)
    boundary = np.zeros(len(cloud.points), bool)
    occluded = bool(on_boundary.sum() >= MIN_BOUNDARY_SHARE * on_contour.sum())
    seen = on_boundary & (own_depth > 0)
    if occluded and seen.any() and len(cloud.points):
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
    """Return for each pixel of the mask: on the contour, on the occlusion boundary, depth of the object there."""
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
"""Voxel side, in scaled units, of every cloud that is described, in training too: colour vectors count points."""


def prepare_instance(frame: RGBDFrame, label: int, sigma_s: float, with_rim: bool = True) -> PreparedInstance:
    """Compute the cloud of one instance and its occlusion boundary, on the descriptors' voxel grid.

    Args:
        frame: the frame.
        label: one of `frame.instances`.
        sigma_s: scaled units per metre, see `DescriptorConfig`.
        with_rim: whether to find the rim, see `DescriptorConfig.uses_rim`.
    """
    cloud = instance_cloud(frame, label, with_rim)
    if cloud.reason is not None:
        return cloud
    occluded, boundary = find_occlusion(frame, cloud)
    # Flags are further colour channels: a voxel is on the boundary if any of its points is, on the rim if most are.
    flags = [boundary] if cloud.rim is None else [boundary, cloud.rim]
    channels = np.column_stack([cloud.colors, np.stack(flags, axis=1) * np.uint8(255)])
    points, channels = downsample_to_fit(cloud.points, channels, DESCRIPTOR_VOXEL / sigma_s)
    rim = None if cloud.rim is None else channels[:, 4] > 127
    if rim is not None and 2 * rim.sum() > len(rim):  # a narrow object has no inside
        rim[:] = False
    colors, boundary = channels[:, :3], channels[:, 3] > 0
    return PreparedInstance(label, points, colors, boundary, occluded, cloud.kept_by_fallback, rim=rim)


def pack_instances(instances: Sequence[PreparedInstance], n_rows: int, capacity: int | None = None) -> "PointClouds":
    """Pack instances as a batch of `n_rows` clouds in host memory; the last ones are empty.

    Args:
        instances: at most `n_rows`.
        n_rows: B, clouds in the batch.
        capacity: N, points in a row; by default the bucket of the largest cloud, see `PointClouds.pack`.
    """
    from thor2_jax.types import PointClouds  # imports JAX, which preparation does not need

    padded = [*instances, *[EMPTY_INSTANCE] * (n_rows - len(instances))]
    clouds = [(instance.points, instance.colors) for instance in padded]
    boundary, rim = [instance.boundary for instance in padded], [instance.rim for instance in padded]
    return PointClouds.pack(clouds, capacity, boundary=boundary, rim=rim, on_host=True)
