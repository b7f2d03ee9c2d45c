"""Pieces by watershed: regions grow from sure pixels of things and of the background until they meet at colour edges.

Near depth edges and where depth is missing, the colour image alone decides.
"""

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from thor2_jax.segmentation.foreground import FLAT, UNIT, Evidence
from thor2_jax.segmentation.pixels import Mask, close, components, grow, nearest_known, shrink, watershed
from thor2_jax.segmentation.planes import DepthImage

__all__ = ["Pieces", "flood"]

LEAST_MARKER = 10
"""Least pixels of a marker."""

RIM = 3
"""Width, pixels, of the square within which depth is not trusted at the border of a thing."""

NECK = 2.4
"""Half the width, pixels, of a neck that divides a body."""

CLEAR = 0.3
"""Largest contrast, in units, of a pixel that is clearly the plane's."""

BLEEDING = 7
"""Width, pixels, of the square within which depth of a thing may reach over the plane."""

OUTSIDE = 21
"""Width, pixels, of the square within which things may reach over pixels without depth beyond the plane."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pieces:
    """Parts of the foreground.

    Attributes:
        labels: [H, W] int32; 0 is background.
        colored: [n] for each label whether the part was found by its colour alone.
    """

    labels: NDArray[np.int32]
    colored: NDArray[np.bool_]


def flood(color: NDArray[np.uint8], depth: DepthImage, evidence: Evidence, steps: Mask, folds: Mask) -> Pieces:
    """Return the pieces between edges.

    Args:
        color: [H, W, 3] uint8, a little blurred.
        depth: the depth image.
        evidence: probabilities by height and colour.
        steps: [H, W], of depth.
        folds: [H, W], of depth.
    """
    high = evidence.high | (close(evidence.high, 5) & ~depth.valid)
    like_plane = evidence.plain & (evidence.contrast < CLEAR * UNIT) & (evidence.heights < FLAT)
    like_plane &= ~shrink(high, BLEEDING)
    body = high & ~like_plane
    markers, n_bodies = _body_markers(body, steps | grow(folds, 3) | (grow(folds, 5) & grow(steps, 3)))
    body_numbers, body_sizes = components(body)
    marked = np.zeros(len(body_sizes), bool)
    marked[body_numbers[markers > 0]] = True
    alone = ~marked & (body_sizes >= LEAST_MARKER)  # bodies that are all rim
    rank = np.cumsum(alone) * alone
    markers += np.where(rank > 0, rank + n_bodies, 0).astype(np.int32)[body_numbers]
    n_bodies += int(alone.sum())
    body = (marked | alone)[body_numbers]
    colored = close(evidence.colored | (high & ~like_plane & ~body & (evidence.contrast > UNIT)), 3)
    near = grow(body, 5)
    numbers, n_colored = _colored_markers(colored & ~near, near, depth.valid)
    markers = np.where(numbers > 0, numbers + n_bodies, markers)
    unknown = (
        (near & ~(like_plane & ~evidence.high))
        | colored
        | _unknown_without_depth(depth, evidence, body, near | colored, like_plane)
    )
    markers += 1  # the background is 1, and 0 is flooded
    markers[(markers == 1) & unknown] = 0
    labels = watershed(color, markers) - 1
    return Pieces(labels, np.arange(1 + n_bodies + n_colored) > n_bodies)


def _body_markers(body: Mask, edges: Mask) -> tuple[NDArray[np.int32], int]:
    """Return the numbers [H, W] of the inner parts of bodies between edges, and how many there are.

    Edges have gaps, so parts are also divided at necks. `merge_pieces` undoes what was no edge.
    """
    numbers, sizes = components(shrink(body, RIM) & ~edges)
    room = np.asarray(cv2.distanceTransform((numbers > 0).view(np.uint8), cv2.DIST_L2, 3))
    parts, part_sizes = components((room > NECK) & (sizes >= LEAST_MARKER)[numbers])
    part_sizes[part_sizes < LEAST_MARKER] = 0
    whole = sizes >= LEAST_MARKER
    whole[numbers[part_sizes[parts] > 0]] = False
    kept = part_sizes > 0
    markers = (np.cumsum(kept) * kept).astype(np.int32)[parts]
    n_parts = int(kept.sum())
    if n_parts > 0:  # the rest of a divided component goes to its nearest part
        known = markers > 0
        nearest = nearest_known(known)
        same = (numbers[known].take(nearest) == numbers) & (numbers > 0)
        markers = np.where(same, markers[known].take(nearest), 0)
    markers += np.where(whole, np.cumsum(whole) + n_parts, 0).astype(np.int32)[numbers]
    return markers, n_parts + int(whole.sum())


def _colored_markers(colored: Mask, near: Mask, valid: Mask) -> tuple[NDArray[np.int32], int]:
    """Return the numbers [H, W] of things that are found by their colour, and how many there are.

    What is beside a body and has no depth is left to the flood.
    """
    numbers, sizes = components(colored, connectivity=8)
    n_valid = np.bincount(numbers[valid], minlength=len(sizes))
    beside = np.zeros(len(sizes), bool)
    beside[numbers[grow(near, 3)]] = True
    kept = (sizes >= LEAST_MARKER) & (~beside | (n_valid > 0.5 * sizes))
    return (np.cumsum(kept) * kept).astype(np.int32)[numbers], int(kept.sum())


def _unknown_without_depth(depth: DepthImage, evidence: Evidence, body: Mask, things: Mask, like_plane: Mask) -> Mask:
    """Return pixels without depth that may belong to a thing."""
    wide = grow(body, OUTSIDE)
    beside = grow(things, 5) & ~like_plane
    colored = (evidence.contrast > UNIT) & ~evidence.plain & evidence.region
    return ~depth.valid & ((~evidence.region & wide) | beside | colored)
