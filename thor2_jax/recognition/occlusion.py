"""Which instances are hidden in part, and where (paper, section "Recognition").

A pixel on the contour of an instance's mask belongs to the occlusion boundary if the pixel beside it belongs to another
instance that is nearer, or if there is none beside it: the image ends. Masks leave gaps between objects and depth
cameras give no depth along edges, where both are needed, so either side is looked for within a few steps away from the
contour.
"""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thor2_jax.recognition.frames import RGBDFrame, pixel_rays
from thor2_jax.recognition.instance_clouds import InstanceCloud

__all__ = ["Occlusion", "find_occlusion"]

STEPS = 6
"""Pixels looked at on either side of the contour for one with valid depth."""

GAP = 3
"""Background pixels between two masks that are passed over."""

MARGIN = max(STEPS, GAP + 1)
"""Pixels past the contour that are ever looked at."""

NEARER = 0.01
"""Metres by which the other instance must be nearer: more than depth noise between two that touch."""

MIN_SHARE = 0.05
"""An instance is occluded if this share of its contour is occlusion boundary: a few noisy pixels are not."""

BACKGROUND, OUTSIDE = 0, -1
"""In the place of an instance's number: of none, and past the image's border."""

REACH = 0.012
"""Metres from a boundary pixel's point within which the nearest point of the cloud is marked."""


@dataclasses.dataclass(frozen=True, eq=False)
class Occlusion:
    """What hides an instance.

    Attributes:
        occluded: it is hidden in part by another instance, or cut by the image's border.
        boundary: [n] bool, points of its cloud that lie on the occlusion boundary; none if it is not occluded.
    """

    occluded: bool
    boundary: NDArray[np.bool_]


def find_occlusion(frame: RGBDFrame, cloud: InstanceCloud) -> Occlusion:
    """Occlusion of one instance of a frame.

    Args:
        frame: the frame.
        cloud: its cloud; one of `instance_clouds(frame)`.
    """
    pixels = frame.instance_pixels[cloud.label]
    on_contour, on_boundary, own_depth = _contour(frame, cloud.label, pixels)
    boundary = np.zeros(len(cloud.points), bool)
    occluded = bool(on_boundary.sum() >= MIN_SHARE * on_contour.sum())
    seen = on_boundary & (own_depth > 0)
    if occluded and seen.any() and len(cloud.points):
        edge = pixel_rays(pixels[seen], frame.labels.shape[1], frame.intrinsics) * own_depth[seen, None]
        distance, nearest = KDTree(cloud.points, leafsize=32, balanced_tree=False, compact_nodes=False).query(edge)
        boundary[nearest[distance <= REACH]] = True
    return Occlusion(occluded, boundary)


def _window(
    frame: RGBDFrame, pixels: NDArray[np.intp]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.intp]]:
    """Labels and depth around a mask, `MARGIN` pixels more on every side, and the mask's flat indices there."""
    height, width = frame.labels.shape
    row, column = np.divmod(pixels, width)
    top, left = row.min() - MARGIN, column.min() - MARGIN
    shape = row.max() - top + MARGIN + 1, column.max() - left + MARGIN + 1
    inside = slice(max(top, 0), min(top + shape[0], height)), slice(max(left, 0), min(left + shape[1], width))
    here = tuple(slice(part.start - first, part.stop - first) for part, first in zip(inside, (top, left), strict=True))
    labels, depth = np.full(shape, OUTSIDE, np.int64), np.zeros(shape, np.float32)
    labels[here], depth[here] = frame.labels[inside], frame.depth_m[inside]
    return labels, depth, (row - top) * shape[1] + column - left


def _contour(
    frame: RGBDFrame, label: int, pixels: NDArray[np.intp]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float32]]:
    """For each pixel of the mask: is it on the contour, on the occlusion boundary, and how deep is the object there."""
    window, depth, places = _window(frame, pixels)
    labels, depth = window.ravel(), depth.ravel()
    steps = (1, -1, window.shape[1], -window.shape[1])
    edges = [np.flatnonzero(labels[places + step] != label) for step in steps]
    edge, step = np.concatenate(edges), np.repeat(steps, [len(found) for found in edges])
    here = places[edge]

    def first_depth(start: NDArray[np.intp], step: NDArray[np.intp], wanted: Any) -> NDArray[np.float32]:
        """First valid depth of an instance from each place on along its step; 0 where none is within `STEPS` pixels."""
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
