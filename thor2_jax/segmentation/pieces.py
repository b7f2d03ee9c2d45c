"""Pieces of things, and those that belong together.

Pieces are found by watershed: regions grow from sure pixels of things and of the background until they meet at colour
edges. Near depth edges and where depth is missing, the colour image alone decides. Neighbours without an edge of depth
between them, and both sides of hollow things, are then merged.
"""

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from thor2_jax.segmentation.foreground import UNIT, Evidence
from thor2_jax.segmentation.pixels import Mask, close, components, grow, nearest_known, shrink, watershed
from thor2_jax.segmentation.planes import DepthImage

__all__ = ["flood", "merge_pieces"]

LEAST_MARKER = 10
"""Least pixels of a marker."""

RIM = 3
"""Width, pixels, of the square within which depth is not trusted at the border of a thing."""

NECK = 2.4
"""Half the width, pixels, of a neck that divides a body."""

OUTSIDE = 21
"""Width, pixels, of the square within which things may reach over pixels without depth beyond the plane."""

LEAST_CONTACT = 0.08
"""Least share of the border of the smaller piece that two pieces of one thing have in common."""

EDGE = 0.25
"""Least share of a common border that is a step, for two things."""

PART = 90.0
"""Largest colour difference between a body and a part of it that was found by its colour."""

GAP = 5
"""Pixels between parts of one thing that are found by their colour, less one."""

OPEN = 0.3
"""Least share of the border of a shadow along the plane; what is darker in a bowl is its bottom."""

SHADOW = 21
"""Width, pixels, of the square around a body in which its shadow begins; shadows are divided from other things."""

ATTACHED = 0.15
"""Least share of the border of a piece without depth, an inner side or a shadow, along the thing it belongs to."""

TALL, LOW = 0.035, 0.02
"""Heights, metres: a tall piece reaches the first; between pieces that stay below the second, depth has no steps."""

SAME_HEIGHT, RIM_SHARE = 0.015, 97
"""Largest difference, metres, of the upper rims of the two sides of a hollow thing, and their percentile of heights."""

CONCAVE = 0.1
"""Least bend of the inner side of a hollow thing, as a share of its size."""

BEFORE, AFTER = 2, 2
"""Pixels beside a border at which the two pieces are compared."""


def flood(
    color: NDArray[np.uint8], depth: DepthImage, evidence: Evidence
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return the pieces between edges.

    Args:
        color: [H, W, 3] uint8, a little blurred.
        depth: the depth image.
        evidence: probabilities by height and colour, and edges of depth.

    Returns:
        Labels [H, W], 0 for the background, and for each label [n] whether the piece was found by its colour alone.
    """
    steps, folds = evidence.steps[0] | evidence.steps[1], evidence.folds
    high = evidence.high | (close(evidence.high, 5) & ~depth.valid)
    markers, n_bodies = _body_markers(high, steps | grow(folds, 3) | (grow(folds, 5) & grow(steps, 3)))
    body_numbers, body_sizes = components(high)
    marked = np.zeros(len(body_sizes), bool)
    marked[body_numbers[markers > 0]] = True
    alone = ~marked & (body_sizes >= LEAST_MARKER)  # bodies that are all rim
    rank = np.cumsum(alone) * alone
    markers += np.where(rank > 0, rank + n_bodies, 0).astype(np.int32)[body_numbers]
    n_bodies += int(alone.sum())
    body = (marked | alone)[body_numbers]
    colored = close(evidence.colored | (high & ~body & (evidence.contrast > UNIT)), GAP)
    near = grow(body, 5)
    n_pieces = n_bodies
    shades, sizes = components(evidence.shade)
    beside_body = np.bincount(shades[grow(body, SHADOW)], minlength=len(sizes)) > 0
    shade = evidence.shade & beside_body[shades]
    for part in (colored & ~near & ~shade, colored & ~near & shade):
        numbers, n_colored = _colored_markers(part)
        markers = np.where(numbers > 0, numbers + n_pieces, markers)
        n_pieces += n_colored
    beside = grow(near | colored, 5) | (~evidence.region & grow(body, OUTSIDE))
    unknown = near | colored | (~depth.valid & beside)
    markers += 1  # the background is 1, and 0 is flooded
    markers[(markers == 1) & unknown] = 0
    labels = watershed(color, markers) - 1
    return labels, np.arange(1 + n_pieces) > n_bodies


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


def _colored_markers(colored: Mask) -> tuple[NDArray[np.int32], int]:
    """Return the numbers [H, W] of things that are found by their colour, and how many there are."""
    numbers, sizes = components(colored, connectivity=8)
    kept = sizes >= LEAST_MARKER
    return (np.cumsum(kept) * kept).astype(np.int32)[numbers], int(kept.sum())


@dataclasses.dataclass(frozen=True, eq=False)
class _Borders:
    """Borders between pairs of neighbouring pieces [N], the smaller number first; the background is a piece, too.

    Attributes:
        pairs: [N, 2] the pieces of each pair.
        length: [N] border pixels.
        step: [N] share of them at a step.
        contrast: [N] mean colour difference across, sum over the channels.
        behind: [N] share of them where the second piece is farther than the first, less where it is nearer.
        perimeter: [n] border pixels of each piece.
    """

    pairs: NDArray[np.int64]
    length: NDArray[np.intp]
    step: NDArray[np.float64]
    contrast: NDArray[np.float64]
    behind: NDArray[np.float64]
    perimeter: NDArray[np.intp]


@dataclasses.dataclass(frozen=True, eq=False)
class _Shapes:
    """Which pieces [n] are tall, low, mostly without depth or in the shade, by every second pixel in each direction."""

    tall: NDArray[np.bool_]
    low: NDArray[np.bool_]
    unknown: NDArray[np.bool_]
    shade: NDArray[np.bool_]


def merge_pieces(
    labels: NDArray[np.int32],
    colored: NDArray[np.bool_],
    color: NDArray[np.uint8],
    depth: DepthImage,
    evidence: Evidence,
) -> NDArray[np.int32]:
    """Return the labels [H, W] of the pieces of `flood` after merging; the arguments are as there."""
    n = len(colored)
    borders = _find_borders(labels, n, color, depth, evidence)
    shapes = _measure(labels, n, borders, evidence)
    apart = borders.length < LEAST_CONTACT * borders.perimeter[borders.pairs].min(axis=1)
    together = _belong_together(borders, shapes, colored, apart)
    for k, (a, b) in enumerate(borders.pairs.tolist()):
        if not together[k] and not apart[k] and a > 0 and shapes.tall[a] and shapes.tall[b]:
            together[k] = _is_hollow(k, a, b, borders, labels, depth, evidence)
    a, b = borders.pairs.T
    groups = _components(borders.pairs[together & (shapes.shade[a] == shapes.shade[b])], n)
    shadow = _is_shadow(groups, borders, shapes)
    groups = _components(borders.pairs[together & ~shadow[a] & ~shadow[b]], n)
    groups[shadow] = 0
    return groups[labels]


def _components(pairs: NDArray[np.int64], n: int) -> NDArray[np.int32]:
    """Return the numbers [n] of the groups of connected pieces; the background is connected to none and has 0."""
    pairs = pairs[pairs[:, 0] > 0]
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (n, n))
    return np.asarray(connected_components(graph, directed=False)[1], np.int32)


def _is_shadow(groups: NDArray[np.int32], borders: _Borders, shapes: _Shapes) -> NDArray[np.bool_]:
    """Return which pieces [n] lie in the shade along a tall thing and are part of nothing else."""
    alone = ~np.isin(groups, groups[~shapes.shade])
    tall = np.isin(groups, groups[shapes.tall])
    ends, others = np.concatenate([borders.pairs, borders.pairs[:, ::-1]]).T
    along = np.bincount(ends, np.tile(borders.length, 2) * tall[others], minlength=len(groups))
    return alone & (along > ATTACHED * borders.perimeter)


def _belong_together(
    borders: _Borders, shapes: _Shapes, colored: NDArray[np.bool_], apart: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which pairs [N] are of one thing, but for hollow things."""
    a, b = borders.pairs.T
    part_by_color = (colored[a] != colored[b]) & (shapes.tall[a] | shapes.tall[b])
    is_part = (borders.contrast < PART) | _main_contact(borders, shapes, part_by_color, colored)
    cases = [part_by_color, shapes.low[a] & shapes.low[b], apart]
    answers: list[Any] = [is_part, True, False]
    return np.select(cases, answers, borders.step < EDGE)


def _main_contact(
    borders: _Borders, shapes: _Shapes, parts: NDArray[np.bool_], colored: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which pairs [N] of a body and a piece that was found by its colour are one thing without a step between.

    The body must be that with the longest common border, and the piece must not be in the shade.
    """
    part = np.where(colored[borders.pairs[:, 0]], *borders.pairs.T)
    length = borders.length * parts
    longest = np.zeros(len(colored), length.dtype)
    np.maximum.at(longest, part, length)
    joined = (shapes.unknown[part] | (borders.step < EDGE)) & ~shapes.shade[part]
    return parts & joined & (length == longest[part]) & (length > ATTACHED * borders.perimeter[part])


def _is_hollow(
    k: int, a: int, b: int, borders: _Borders, labels: NDArray[np.int32], depth: DepthImage, evidence: Evidence
) -> bool:
    """Return whether the piece that is farther is the inner side of the other: concave, with the same upper rim."""
    inner, outer = (b, a) if borders.behind[k] > 0 else (a, b)
    if borders.length[k] < ATTACHED * borders.perimeter[inner]:
        return False
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
    return bool(bend > noise and bend > CONCAVE * inverse.mean() * np.sqrt(squared.mean()))


def _measure(labels: NDArray[np.int32], n: int, borders: _Borders, evidence: Evidence) -> _Shapes:
    every = labels[::2, ::2].ravel()
    things = np.flatnonzero(every)
    every = every[things]
    heights = evidence.heights[::2, ::2].ravel()[things]
    size = np.maximum(np.bincount(every, minlength=n), 1)
    tall = np.bincount(every[heights > TALL], minlength=n) > 0.1 * size
    low = np.bincount(every[heights > LOW], minlength=n) < 0.1 * size
    unknown = np.bincount(every[heights == 0], minlength=n) > 0.5 * size
    shade = np.bincount(every[evidence.shade[::2, ::2].ravel()[things]], minlength=n) > 0.5 * size
    to_plane = np.bincount(borders.pairs[:, 1], borders.length * (borders.pairs[:, 0] == 0), minlength=n)
    return _Shapes(tall, low, unknown, shade & (to_plane > OPEN * borders.perimeter))


def _find_borders(
    labels: NDArray[np.int32], n: int, color: NDArray[np.uint8], depth: DepthImage, evidence: Evidence
) -> _Borders:
    flat, pixels = labels.ravel(), color.reshape(-1, 3)
    z = depth.z.ravel()
    parts = []
    for step, steps in zip((1, labels.shape[1]), evidence.steps, strict=True):
        near_step = grow(steps, 5).ravel()
        here = np.flatnonzero(flat[:-step] != flat[step:])
        a, b = flat[here], flat[here + step]
        swap = a > b
        before, after = np.maximum(here - BEFORE * step, 0), np.minimum(here + AFTER * step, flat.size - 1)
        difference = np.abs(pixels[before].astype(np.int16) - pixels[after]).sum(axis=1)
        at_a, at_b = np.where(swap, after, before), np.where(swap, before, after)
        behind = np.where((z[at_a] > 0) & (z[at_b] > 0), np.sign(z[at_b] - z[at_a]), 0)
        a, b = np.minimum(a, b), np.maximum(a, b)
        parts.append((a, b, near_step[here], difference, behind))
    a, b, at_step, difference, behind = (np.concatenate(values) for values in zip(*parts, strict=True))
    keys, pair = np.unique(a.astype(np.int64) * n + b, return_inverse=True)
    length = np.bincount(pair, minlength=len(keys))
    pairs = np.stack(np.divmod(keys, n), axis=1)
    perimeter = np.bincount(pairs.ravel(), np.repeat(length, 2), minlength=n).astype(np.intp)
    step_share, contrast, behind = (
        np.bincount(pair, values, minlength=len(keys)) / length for values in (at_step, difference, behind)
    )
    return _Borders(pairs, length, step_share, contrast, behind, perimeter)
