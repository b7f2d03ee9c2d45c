"""Refinement of a segmentation by recognition, since objects in a pile touch without a visible edge.

labels = segment_known(frame, labels, recognize)          # labels of any segmenter, [H, W]
labels = fit_masks(frame, labels, locate)                 # if the surfaces of the objects are known

Each piece of the segmentation is divided into parts of similar colour and place. The parts, unions of neighbouring
parts and whole pieces are candidates for objects and are all recognized. A piece is divided if its best division
contains objects of different names. Neighbours are then merged repeatedly if their union is recognized better than each
of them. In the end, pixels go to the object on whose surface their points lie.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from thor2_jax.frames.frames import RGBDFrame, backproject
from thor2_jax.segmentation.pixels import Mask, components, nearest_known, renumbered, window

__all__ = ["Distances", "fit_masks", "segment_known"]

Parts = frozenset[int]
"""Numbers of the parts of a candidate or of a whole piece."""

Answer = tuple[str | None, float]
"""Name (None for an unknown object) and confidence."""

Distances = Callable[[NDArray[np.floating]], NDArray[np.float64]]
"""Function from points [n, 3] in the camera frame to their distances [n] from the surface of an object, metres."""

LEAST_PART, MOST_PARTS = 1000, 6
"""Smallest average number of pixels of a part, and largest number of parts of a piece."""

MOST_JOINED = 4
"""Largest number of parts in a candidate that is not a whole piece."""

CELL = (25.0, 0.06)
"""Equivalent distances in colour (CIELAB with 0.6 of the lightness) and in space (metres)."""

SMOOTH = 9
"""Width, pixels, of the median filter of the colours."""

BESIDE = 7
"""Width, pixels, of the square by which parts are grown to find their neighbours."""

MARGIN = 10
"""Width, pixels, of the margin around a candidate that its recognition can read."""

LEAST = 0.8
"""Lowest confidence at which a candidate counts as known."""

MOST = 0.99
"""Confidences are clipped to this value."""

SHARE = 0.5
"""Smallest fraction of a piece that must be recognized in its division."""

COST, COST_OF_UNKNOWN = 0.3, 0.5
"""Penalties for each known and each unknown candidate in a division: these log-odds times the area of the piece."""

GAIN = 1.0
"""Smallest increase of the log-odds of a known object when two objects are merged."""


def segment_known(
    frame: RGBDFrame, labels: NDArray[np.integer], recognize: Callable[[Sequence[RGBDFrame]], Sequence[Answer]]
) -> NDArray[np.int32]:
    """Return labels after pieces are divided and merged where the results are known objects.

    Args:
        frame: colour, depth and intrinsics; its labels are not read.
        labels: [H, W], labels of a segmenter.
        recognize: function from frames to the answer for the instance with label 1 in each frame; other labels are
            neighbours.

    Returns:
        Labels [H, W]: 0 is background, and the objects are numbered from 1.
    """
    parts, piece_of = _parts(frame, labels)
    beside = _neighbours(parts)
    sizes = np.bincount(parts.ravel(), minlength=len(piece_of))
    known = _Known(lambda candidates: recognize([_shown(frame, parts, each) for each in candidates]), sizes)
    pieces = [frozenset(np.flatnonzero(piece_of == k).tolist()) for k in range(1, int(piece_of.max()) + 1)]
    inside = [_candidates(piece, beside) for piece in pieces]
    known.look_at([each for candidates in inside for each in candidates])
    things = {thing for piece, each in zip(pieces, inside, strict=True) for thing in _best_division(piece, each, known)}
    while merged := _merged(things, beside, known):
        things = merged
    result = np.zeros(parts.shape, np.int32)
    for number, thing in enumerate(sorted(things, key=min), start=1):
        result[_mask(parts, thing)] = number
    return result


ROUNDS = 2
"""Number of times that surfaces are fitted to masks, and masks to surfaces."""

ON_SURFACE, OFF_SURFACE = 0.008, 0.015
"""A point within ON_SURFACE of another object can go to it; a point beyond OFF_SURFACE leaves its object; metres."""

LEAST_PIXELS = 200
"""Number of pixels of the smallest separate piece; smaller ones go to the nearest piece."""


def fit_masks(
    frame: RGBDFrame, labels: NDArray[np.int32], locate: Callable[[RGBDFrame], Mapping[int, Distances]]
) -> NDArray[np.int32]:
    """Return labels that fit the surfaces of known objects.

    A pixel goes to the known object whose surface is nearest to its point, if that is within `ON_SURFACE`. What is
    farther than `OFF_SURFACE` from the surface of its known object becomes a piece of its own. Otherwise, pieces of
    unknown objects do not change.

    Args:
        frame: colour, depth and intrinsics; its labels are not read.
        labels: [H, W]; 0 is background, and the objects are numbered from 1.
        locate: function from a frame with labels to label -> distances from the surface, for all known objects.

    Returns:
        Labels [H, W]: 0 is background as before, and the objects are numbered from 1.
    """
    points = backproject(frame.depth_m, frame.intrinsics)
    for _ in range(ROUNDS):
        surfaces = locate(dataclasses.replace(frame, labels=labels))
        if not surfaces:
            break
        known, at = np.array(list(surfaces)), (labels > 0) & (frame.depth_m > 0)
        distance = np.stack([distances(points[at]) for distances in surfaces.values()])  # [known, n]
        is_own = known[:, None] == labels[at]
        own, nearest = np.where(is_own, distance, np.inf).min(axis=0), distance.min(axis=0)
        moves, leaves = (nearest < ON_SURFACE) & (nearest < own), is_own.any(axis=0) & (own > OFF_SURFACE)
        rest = int(labels.max()) + 1
        fitted = np.where(np.isin(labels, known), 0, labels)  # pixels of known objects without depth follow later
        fitted[at] = np.select([moves, leaves], [known[distance.argmin(axis=0)], rest], labels[at])
        labels = _tidied(fitted, labels, rest)
    return labels


def _tidied(fitted: NDArray[np.int32], labels: NDArray[np.int32], rest: int) -> NDArray[np.int32]:
    """Return fitted labels without small pieces of changed objects; the separate pieces of `rest` get numbers each."""
    tidied, last = np.zeros_like(fitted), 0
    for label in np.unique(fitted[fitted > 0]):
        mask = fitted == label
        numbers, sizes = mask.astype(np.int32), np.array([0, mask.sum()])
        if (mask != (labels == label)).any():
            numbers, sizes = components(mask)
        kept = sizes >= max(LEAST_PIXELS if label == rest else min(LEAST_PIXELS, sizes.max()), 1)
        numbers, end = renumbered(numbers, kept, last)
        if label != rest:
            numbers, end = np.minimum(numbers, last + 1), last + 1
        tidied, last = tidied + numbers, end
    is_kept = tidied > 0
    if not is_kept.any():
        return labels
    return np.where(labels > 0, tidied[is_kept].take(nearest_known(is_kept)), 0)


class _Known:
    """Recognized candidates.

    Attributes:
        area: candidate -> number of pixels.
        name: candidate -> name, None for an unknown object.
        odds: candidate -> log-odds of the confidence, 0 for an unknown object.
    """

    def __init__(self, recognize: Callable[[Sequence[Parts]], Sequence[Answer]], sizes: NDArray[np.intp]) -> None:
        self.area: dict[Parts, int] = {}
        self.name: dict[Parts, str | None] = {}
        self.odds: dict[Parts, float] = {}
        self._recognize, self._sizes = recognize, sizes

    def look_at(self, candidates: Sequence[Parts]) -> None:
        """Recognize the new candidates in one call."""
        new = [each for each in dict.fromkeys(candidates) if each not in self.odds]
        for each, (name, confidence) in zip(new, self._recognize(new), strict=True):
            counts = name is not None and confidence >= LEAST
            self.name[each] = name if counts else None
            self.odds[each] = float(logit(min(confidence, MOST))) if counts else 0.0
            self.area[each] = int(self._sizes[list(each)].sum())


def _parts(frame: RGBDFrame, labels: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Return the part of each pixel [H, W], 0 for the background, and the piece of each part [n + 1]."""
    lab = np.asarray(cv2.cvtColor(cv2.medianBlur(frame.color, SMOOTH), cv2.COLOR_RGB2LAB), np.float32)
    points = backproject(frame.depth_m, frame.intrinsics)
    features = np.dstack([lab * np.array([0.6, 1, 1], np.float32) / CELL[0], points / CELL[1]]).astype(np.float32)
    parts, piece_of = np.zeros(labels.shape, np.int32), [0]
    numbers = np.unique(labels)
    for piece, label in enumerate(numbers[numbers > 0], start=1):
        mask = labels == label
        known = mask & (frame.depth_m > 0)
        count = min(int(known.sum()) // LEAST_PART, MOST_PARTS)
        numbers_in_piece = np.where(mask, 1, 0).astype(np.int32)
        if count > 1:
            cv2.setRNGSeed(0)  # equal frames get equal labels
            stop = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 20, 1e-3)
            start = np.zeros((int(known.sum()), 1), np.int32)
            _, cluster, _ = cv2.kmeans(features[known], count, start, stop, 1, cv2.KMEANS_PP_CENTERS)
            clusters = np.zeros(labels.shape, np.int32)
            clusters[known] = np.asarray(cluster).ravel() + 1
            numbers_in_piece = _connected(clusters, mask, count)
        parts[mask] = numbers_in_piece[mask] + len(piece_of) - 1
        piece_of += [piece] * int(numbers_in_piece.max())
    return parts, np.array(piece_of, np.intp)


def _connected(clusters: NDArray[np.int32], mask: Mask, count: int) -> NDArray[np.int32]:
    """Return the numbers [H, W] of large connected parts of clusters; other pixels of the mask get the nearest part."""
    numbers = np.zeros(clusters.shape, np.int32)
    for cluster in range(1, count + 1):
        here, _ = components(clusters == cluster)
        numbers = np.where(here > 0, here + numbers.max(), numbers)
    sizes = np.bincount(numbers.ravel())
    sizes[0] = 0
    large = np.argsort(-sizes, kind="stable")[:MOST_PARTS]
    kept = large[sizes[large] >= min(LEAST_PART // 4, sizes.max())]
    rank = np.zeros(len(sizes), np.int32)
    rank[kept] = np.arange(1, len(kept) + 1)
    known = rank[numbers] > 0
    return np.where(mask, rank[numbers[known]].take(nearest_known(known)), 0)


def _neighbours(parts: NDArray[np.int32]) -> dict[int, set[int]]:
    """Return the neighbours of each part."""
    beside: dict[int, set[int]] = {part: set() for part in range(1, int(parts.max()) + 1)}
    grown = cv2.dilate(parts.astype(np.float32), np.ones((BESIDE, BESIDE), np.uint8)).astype(np.int32)
    grown = np.where(parts > 0, parts, grown)
    for a, b in ((grown[:-1], grown[1:]), (grown[:, :-1], grown[:, 1:])):
        at = (a != b) & (a > 0) & (b > 0)
        for one, other in np.unique(np.stack([a[at], b[at]], axis=1), axis=0).tolist():
            beside[one].add(other)
            beside[other].add(one)
    return beside


def _candidates(piece: Parts, beside: dict[int, set[int]]) -> list[Parts]:
    """Return the candidates in a piece, the piece itself first."""
    level = {frozenset([part]) for part in piece}
    candidates = {piece, *level}
    for _ in range(MOST_JOINED - 1):
        level = {each | {other} for each in level for part in each for other in (beside[part] & piece) - each}
        candidates |= level
    return [piece, *sorted(candidates - {piece}, key=sorted)]


def _mask(parts: NDArray[np.int32], candidate: Parts) -> Mask:
    wanted = np.zeros(int(parts.max()) + 1, bool)
    wanted[list(candidate)] = True
    return wanted[parts]


def _shown(frame: RGBDFrame, parts: NDArray[np.int32], candidate: Parts) -> RGBDFrame:
    """Return the section of a frame around a candidate; the candidate has the label 1, other parts higher labels."""
    mask = _mask(parts, candidate)
    here = window(mask, MARGIN)
    labels = np.where(mask[here], 1, np.where(parts[here] > 0, parts[here] + 1, 0))
    camera = frame.intrinsics
    cx, cy = camera.cx - here[1].start, camera.cy - here[0].start
    moved = dataclasses.replace(camera, cx=cx, cy=cy, width=None, height=None)
    return RGBDFrame(frame.color[here], frame.depth[here], labels, moved)


def _best_division(piece: Parts, candidates: Sequence[Parts], known: _Known) -> tuple[Parts, ...]:
    """Return the division of a piece into candidates with the largest sum of area times log-odds, minus the costs.

    A piece is not divided unless two different known objects result.
    """
    area = known.area[piece]

    @functools.cache
    def best(left: Parts) -> tuple[float, tuple[Parts, ...]]:
        if not left:
            return 0.0, ()
        first, results = min(left), []
        for candidate in candidates:
            if first in candidate and candidate <= left:
                value, others = best(left - candidate)
                odds = known.odds[candidate]
                value += known.area[candidate] * odds - area * (COST if odds else COST_OF_UNKNOWN)
                results.append((value, (candidate, *others)))
        return max(results, key=lambda result: result[0])

    division = best(piece)[1]
    named = [each for each in division if known.odds[each]]
    is_known = len({known.name[each] for each in named}) > 1 and sum(known.area[each] for each in named) >= SHARE * area
    return division if is_known else (piece,)


def _merged(things: set[Parts], beside: dict[int, set[int]], known: _Known) -> set[Parts]:
    """Return objects after neighbours are merged where a known object gains; an empty set if nothing is merged."""
    at = {part: thing for thing in things for part in thing}
    touching = {(at[part], at[other]) for part in at for other in beside[part] if min(at[part]) < min(at[other])}
    pairs = sorted(
        ((a, b) for a, b in touching if len({known.name[a], known.name[b]} - {None}) < 2),
        key=lambda pair: [min(each) for each in pair],
    )
    known.look_at([a | b for a, b in pairs])
    gains = {
        (a, b): known.odds[a | b] - max(known.odds[a], known.odds[b])
        for a, b in pairs
        if {known.name[a], known.name[b]} <= {None, known.name[a | b]}
    }
    left = set(things)
    for a, b in sorted(gains, key=lambda pair: -gains[pair]):
        if gains[a, b] > GAIN and {a, b} <= left:
            left = left - {a, b} | {a | b}
    return left if left != things else set()
