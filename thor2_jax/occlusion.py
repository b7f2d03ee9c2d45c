"""Which instances are hidden in part, and where (paper, section "Recognition").

A pixel on the contour of an instance's mask belongs to the occlusion boundary if the pixel beside it belongs to another
instance that is nearer, or if there is none beside it: the image ends. Masks leave gaps between objects and depth
cameras give no depth along edges, where both are needed, so either side is looked for within a few steps away from the
contour.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thor2_jax.frames import RGBDFrame, pixel_rays
from thor2_jax.instance_clouds import InstanceCloud

__all__ = ["Occlusion", "find_occlusion"]

STEPS = 6
"""Pixels looked at on either side of the contour for one with valid depth."""

GAP = 3
"""Background pixels between two masks that are passed over."""

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
        distance, nearest = KDTree(cloud.points).query(edge)
        boundary[nearest[distance <= REACH]] = True
    return Occlusion(occluded, boundary)


def _contour(
    frame: RGBDFrame, label: int, pixels: NDArray[np.intp]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float32]]:
    """For each pixel of the mask: is it on the contour, on the occlusion boundary, and how deep is the object there."""
    width = frame.labels.shape[1]
    row, column = np.divmod(pixels, width)
    on_contour, on_boundary = np.zeros(len(pixels), bool), np.zeros(len(pixels), bool)
    own_depth = np.zeros(len(pixels), np.float32)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        beside = _label_at(frame, row + down, column + right)
        edge = np.flatnonzero(beside != label)
        on_contour[edge] = True
        r, c, other = row[edge], column[edge], beside[edge]
        own = _first_depth(frame, r, c, (-down, -right), np.full(len(edge), label))
        own_depth[edge] = np.where(own > 0, own, own_depth[edge])
        for k in range(2, GAP + 2):
            other = np.where(other == BACKGROUND, _label_at(frame, r + k * down, c + k * right), other)
        theirs = _first_depth(frame, r + down, c + right, (down, right), other)
        hides = (other != label) & (theirs > 0) & (theirs < own - NEARER)
        on_boundary[edge[hides | (beside[edge] == OUTSIDE)]] = True
    return on_contour, on_boundary, own_depth


def _label_at(frame: RGBDFrame, row: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.int64]:
    height, width = frame.labels.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    found = frame.labels[np.where(inside, row, 0), np.where(inside, column, 0)].astype(np.int64)
    return np.where(inside, found, OUTSIDE)


def _first_depth(
    frame: RGBDFrame, row: NDArray[np.intp], column: NDArray[np.intp], step: tuple[int, int], label: NDArray[np.int64]
) -> NDArray[np.float32]:
    """First valid depth of `label` from each pixel on along `step`; 0 where there is none within `STEPS` pixels."""
    found = np.zeros(len(row), np.float32)
    for k in range(STEPS):
        r, c = row + k * step[0], column + k * step[1]
        usable = (found == 0) & (_label_at(frame, r, c) == label) & (label > BACKGROUND)
        found[usable] = frame.depth_m[r[usable], c[usable]]
    return found
