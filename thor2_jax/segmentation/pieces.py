"""Pieces of objects, and the decision which pieces belong together.

Pieces are found by watershed: regions grow from certain pixels of objects and of the background until they meet at
colour edges. Near depth edges and where depth is missing, the colour image alone decides. Neighbours without a depth
edge between them, and the inner and outer sides of hollow objects, are then merged.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from thor2_jax.segmentation.foreground import UNIT, Evidence
from thor2_jax.segmentation.pixels import Mask, close, components, grow, nearest_known, renumbered, shrink, watershed
from thor2_jax.segmentation.planes import DepthImage

__all__ = ["find_pieces"]

LEAST_MARKER = 10
"""Smallest number of pixels of a marker."""

RIM = 3
"""Width, pixels, of the square around the border of an object in which depth is not trusted."""

NECK = 2.4
"""Half the width, pixels, of a neck that divides a body."""

OUTSIDE = 21
"""Width, pixels, of the square in which objects may extend over pixels without depth outside the plane."""

LEAST_CONTACT = 0.08
"""Smallest common border of two pieces of one object, as a fraction of the smaller piece's border."""

EDGE = 0.25
"""Smallest fraction of the common border of two objects that is a depth step."""

PART = 90.0
"""Largest colour difference between a body and one of its parts that was found by colour."""

GAP = 5
"""Width, pixels, of closed gaps between parts of one object that are found by colour, plus one."""

SHADOW = 21
"""Width, pixels, of the square around a body in which its shadow begins; shadows are pieces of their own."""

ATTACHED = 0.15
"""Smallest fraction of the border of a shadow along tall objects, and of the border of one side of a hollow object (the
side with the shorter border) along the other side."""

TALL, LOW = 0.035, 0.02
"""Heights, metres: a tall piece reaches the first; there are no depth steps between pieces below the second."""

SAME_HEIGHT, RIM_SHARE = 0.015, 97
"""Largest height difference, metres, between the rims of both sides of a hollow object; percentile of a rim."""

BEFORE, AFTER = 2, 2
"""Distances, pixels, from a border at which the two pieces are compared."""


class _Pieces:
    """Pieces [n], and borders between pairs of neighbours [N], the smaller number first; the background is a piece.

    The last four attributes are computed from every second pixel in each direction.

    Attributes:
        pairs: [N, 2] the pieces of each pair.
        length: [N] number of border pixels.
        step: [N] fraction of border pixels at a depth step.
        contrast: [N] mean colour difference across the border, summed over the channels.
        behind: [N] fraction of border pixels where the second piece is farther, minus fraction where it is nearer.
        perimeter: [n] number of border pixels of each piece.
        colored: [n] whether a piece was found by its colour alone.
        tall: [n] whether a piece reaches `TALL`.
        low: [n] whether a piece is below `LOW`.
        unknown: [n] whether a piece is mostly without depth.
        shade: [n] whether a piece is mostly in the shade.
    """

    def __init__(
        self, labels: NDArray[np.int32], colored: Mask, color: NDArray[np.uint8], depth: DepthImage, evidence: Evidence
    ) -> None:
        self.colored = colored
        n, flat, pixels, z = len(colored), labels.ravel(), color.reshape(-1, 3), depth.z.ravel()
        parts = []
        for step, steps in zip((1, labels.shape[1]), evidence.steps, strict=True):
            here = np.flatnonzero(flat[:-step] != flat[step:])
            a, b = flat[here], flat[here + step]
            before, after = np.maximum(here - BEFORE * step, 0), np.minimum(here + AFTER * step, flat.size - 1)
            difference = np.abs(pixels[before].astype(np.int16) - pixels[after]).sum(axis=1)
            farther = np.sign(z[after] - z[before]) * np.where(a < b, 1, -1)
            behind = np.where((z[before] > 0) & (z[after] > 0), farther, 0)
            parts.append((np.minimum(a, b), np.maximum(a, b), grow(steps, 5).ravel()[here], difference, behind))
        a, b, *values = (np.concatenate(each) for each in zip(*parts, strict=True))
        keys, pair = np.unique(a.astype(np.int64) * n + b, return_inverse=True)
        self.length, self.pairs = np.bincount(pair, minlength=len(keys)), np.stack(np.divmod(keys, n), axis=1)
        self.step, self.contrast, self.behind = (
            np.bincount(pair, each, minlength=len(keys)) / self.length for each in values
        )
        ends = self.pairs.ravel()
        self.perimeter = np.bincount(ends, np.repeat(self.length, 2), minlength=n).astype(np.intp)

        every = labels[::2, ::2].ravel()
        things = np.flatnonzero(every)
        every, heights = every[things], evidence.heights[::2, ::2].ravel()[things]
        size = np.maximum(np.bincount(every, minlength=n), 1)
        self.tall = np.bincount(every[heights > TALL], minlength=n) > 0.1 * size
        self.low = np.bincount(every[heights > LOW], minlength=n) < 0.1 * size
        self.unknown = np.bincount(every[heights == 0], minlength=n) > 0.5 * size
        self.shade = np.bincount(every[evidence.shade[::2, ::2].ravel()[things]], minlength=n) > 0.5 * size


def find_pieces(color: NDArray[np.uint8], depth: DepthImage, evidence: Evidence) -> NDArray[np.int32]:
    """Return the pieces between edges, merged if they are one object: labels [H, W], 0 for the background.

    Args:
        color: [H, W, 3] uint8, slightly blurred.
        depth: the depth image.
        evidence: height and colour relative to the planes, and depth edges.
    """
    labels, colored = _flood(color, depth, evidence)
    pieces, n = _Pieces(labels, colored, color, depth, evidence), len(colored)
    smaller = pieces.perimeter[pieces.pairs].min(axis=1)
    apart = pieces.length < LEAST_CONTACT * smaller
    together = _belong_together(pieces, apart)
    a, b = pieces.pairs.T
    may_be_hollow = (a > 0) & (pieces.length > ATTACHED * smaller) & pieces.tall[a] & pieces.tall[b]
    for k in np.flatnonzero(may_be_hollow & ~together).tolist():
        together[k] = _is_hollow(k, pieces, labels, depth, evidence)
    groups = _components(pieces.pairs[together & (pieces.shade[a] == pieces.shade[b])], n)
    shadow = _is_shadow(groups, pieces)
    groups = _components(pieces.pairs[together & ~shadow[a] & ~shadow[b]], n)
    groups[shadow] = 0
    return groups[labels]


def _flood(color: NDArray[np.uint8], depth: DepthImage, evidence: Evidence) -> tuple[NDArray[np.int32], Mask]:
    """Return labels [H, W], and for each label [n] whether the piece was found by its colour alone."""
    steps, folds = evidence.steps[0] | evidence.steps[1], evidence.folds
    high = evidence.high | (close(evidence.high, 5) & ~depth.valid)
    markers, n_bodies = _body_markers(high, steps | grow(folds, 3) | (grow(folds, 5) & grow(steps, 3)))
    body_numbers, body_sizes = components(high)
    marked = np.bincount(body_numbers[markers > 0], minlength=len(body_sizes)) > 0
    alone = ~marked & (body_sizes >= LEAST_MARKER)  # bodies that consist of rim only
    rest, n_bodies = renumbered(body_numbers, alone, n_bodies)
    markers += rest
    body = (marked | alone)[body_numbers]
    colored = close(evidence.colored | (high & ~body & (evidence.contrast > UNIT)), GAP)
    near = grow(body, 5)
    n_pieces = n_bodies
    shades, sizes = components(evidence.shade)
    beside_body = np.bincount(shades[grow(body, SHADOW)], minlength=len(sizes)) > 0
    shade = evidence.shade & beside_body[shades]
    for part in (colored & ~near & ~shade, colored & ~near & shade):
        numbers, sizes = components(part, connectivity=8)
        numbers, n_pieces = renumbered(numbers, sizes >= LEAST_MARKER, n_pieces)
        markers = np.where(numbers > 0, numbers, markers)
    beside = grow(near | colored, 5) | (~evidence.region & grow(body, OUTSIDE))
    unknown = near | colored | (~depth.valid & beside)
    markers += 1  # the background has the marker 1; pixels with 0 are flooded
    markers[(markers == 1) & unknown] = 0
    return watershed(color, markers) - 1, np.arange(1 + n_pieces) > n_bodies


def _body_markers(body: Mask, edges: Mask) -> tuple[NDArray[np.int32], int]:
    """Return the numbers [H, W] of the inner parts of bodies between edges, and the number of these parts.

    Edges have gaps, so parts are also divided at necks. `find_pieces` merges parts without an edge between them again.
    """
    numbers, sizes = components(shrink(body, RIM) & ~edges)
    room = np.asarray(cv2.distanceTransform((numbers > 0).view(np.uint8), cv2.DIST_L2, 3))
    whole = sizes >= LEAST_MARKER
    parts, part_sizes = components((room > NECK) & whole[numbers])
    markers, n_parts = renumbered(parts, part_sizes >= LEAST_MARKER)
    whole[numbers[markers > 0]] = False
    if n_parts > 0:  # the rest of a divided component goes to its nearest part
        known = markers > 0
        nearest = nearest_known(known)
        same = (numbers[known].take(nearest) == numbers) & (numbers > 0)
        markers = np.where(same, markers[known].take(nearest), 0)
    rest, count = renumbered(numbers, whole, n_parts)
    return markers + rest, count


def _components(pairs: NDArray[np.int64], n: int) -> NDArray[np.int32]:
    """Return the group [n] of each piece, where groups are connected; the background is alone and has the number 0."""
    pairs = pairs[pairs[:, 0] > 0]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _is_shadow(groups: NDArray[np.int32], pieces: _Pieces) -> Mask:
    """Return which pieces [n] are in the shade along a tall object and not connected to pieces outside the shade."""
    alone = ~np.isin(groups, groups[~pieces.shade])
    tall = np.isin(groups, groups[pieces.tall])
    ends, others = np.concatenate([pieces.pairs, pieces.pairs[:, ::-1]]).T
    along = np.bincount(ends, np.tile(pieces.length, 2) * tall[others], minlength=len(groups))
    return alone & (along > ATTACHED * pieces.perimeter)


def _belong_together(pieces: _Pieces, apart: Mask) -> Mask:
    """Return which pairs [N] belong to one object, except for the sides of hollow objects."""
    a, b = pieces.pairs.T
    part_by_color = (pieces.colored[a] != pieces.colored[b]) & (pieces.tall[a] | pieces.tall[b])
    is_part = (pieces.contrast < PART) | _main_contact(pieces, part_by_color)
    is_one_body = (pieces.low[a] & pieces.low[b]) | (~apart & (pieces.step < EDGE))
    return np.where(part_by_color, is_part, is_one_body)


def _main_contact(pieces: _Pieces, parts: Mask) -> Mask:
    """Return which pairs [N] of a body and a piece found by its colour are one object without a depth step.

    The body must have the longest common border with the piece.
    """
    part = np.where(pieces.colored[pieces.pairs[:, 0]], *pieces.pairs.T)
    length = pieces.length * parts
    longest = np.zeros(len(pieces.colored), length.dtype)
    np.maximum.at(longest, part, length)
    return parts & (pieces.unknown[part] | (pieces.step < EDGE)) & (length == longest[part])


def _is_hollow(k: int, pieces: _Pieces, labels: NDArray[np.int32], depth: DepthImage, evidence: Evidence) -> bool:
    """Return whether the farther piece of a pair is the other's inner side: concave, with the same upper rim."""
    outer, inner = pieces.pairs[k].tolist() if pieces.behind[k] > 0 else pieces.pairs[k, ::-1].tolist()
    heights = [evidence.heights[::2, ::2][labels[::2, ::2] == piece] for piece in (inner, outer)]
    rims = [float(np.percentile(values, RIM_SHARE)) if len(values) else np.inf for values in heights]
    return abs(rims[0] - rims[1]) < SAME_HEIGHT and _is_concave((labels == inner) & evidence.high, depth)


def _is_concave(mask: Mask, depth: DepthImage) -> bool:
    """Return whether the inner part of a surface is nearer to the camera at its border than in its middle.

    A plane is linear in inverse depth, so the coefficient of the squared distance to the middle is the curvature.
    """
    rows, columns = np.nonzero(shrink(mask, RIM) & depth.valid)
    if len(rows) < 2 * LEAST_MARKER:
        return False
    x, y, inverse = depth.x[columns], depth.y[rows], depth.inverse[rows, columns]
    x, y = x - x.mean(), y - y.mean()
    squared = x * x + y * y
    terms = np.stack([np.ones_like(x), x, y, squared], axis=1).astype(np.float64)
    fitted, *_ = np.linalg.lstsq(terms, inverse)
    bend = fitted[3] * squared.mean()
    noise = np.sqrt(np.mean((terms @ fitted - inverse) ** 2))
    return bool(bend > noise)
