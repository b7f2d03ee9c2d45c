"""Pieces of a segmenter, divided and merged where that gives known objects: things in a pile touch without an edge.

labels = segment_known(frame, labels, recognize)          # labels of any segmenter, [H, W]

Each piece is divided into parts of about one colour and place. The parts, unions of neighbouring ones, whole pieces and
pairs of neighbouring pieces are candidates for an object, which are all recognized. A piece is divided if its best
division has objects of different names, and two pieces are merged if they are recognized much better together.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from thor2_jax.frames.frames import RGBDFrame, backproject
from thor2_jax.segmentation.pixels import Mask, components, label_sizes, nearest_known

__all__ = ["segment_known"]

Parts = frozenset[int]
"""Numbers of parts: a candidate, or a whole piece."""

Answer = tuple[str | None, float]
"""Name, None for an unknown object, and confidence."""

LEAST_PART, MOST_PARTS = 1000, 6
"""Pixels of a part, at least on average, and most parts of a piece."""

MOST_JOINED = 4
"""Most parts in a candidate that is no whole piece."""

CELL = (25.0, 0.06)
"""Distances in colour (CIELAB, with six tenths of the lightness) and in space, metres, that count the same."""

SMOOTH = 9
"""Width, pixels, of the median of colours."""

BESIDE = 7
"""Width, pixels, of the square around a part in which its neighbours are."""

MARGIN = 10
"""Pixels around a candidate that its recognition may read."""

LEAST = 0.8
"""Least confidence of a candidate that counts."""

MOST = 0.99
"""Confidences are clipped to this value."""

SHARE = 0.5
"""Least share of a piece that is recognized in its division."""

COST = 0.5
"""Penalty for each part of a division: these log-odds, times the area of the piece."""

MERGED = 3.0
"""Log-odds that two pieces must gain in the mean when they are merged."""


def segment_known(
    frame: RGBDFrame, labels: NDArray[np.integer], recognize: Callable[[Sequence[RGBDFrame]], Sequence[Answer]]
) -> NDArray[np.int32]:
    """Return labels whose pieces are divided and merged where known objects result.

    Args:
        frame: colour, depth and intrinsics; its labels are not read.
        labels: [H, W], pieces of a segmenter.
        recognize: function from frames to the answer for the instance 1 of each; other labels are things beside it.

    Returns:
        Labels [H, W]: 0 is background, and the things are numbered from 1.
    """
    parts, piece_of = _parts(frame, labels)
    pieces = [frozenset(np.flatnonzero(piece_of == k).tolist()) for k in range(1, int(piece_of.max()) + 1)]
    inside, pairs = _candidates(parts, piece_of, pieces)
    candidates = list(dict.fromkeys([c for each in inside for c in each] + [a | b for a, b in pairs]))
    answers = recognize([_shown(frame, parts, candidate) for candidate in candidates])
    sizes = np.bincount(parts.ravel(), minlength=len(piece_of))
    area = {candidate: int(sizes[list(candidate)].sum()) for candidate in candidates}
    named = dict(zip(candidates, answers, strict=True))
    odds = {candidate: _log_odds(*named[candidate]) for candidate in candidates}
    divided = {piece: _best_division(piece, each, area, odds) for piece, each in zip(pieces, inside, strict=True)}
    for piece, division in divided.items():
        known = [part for part in division if odds[part] > 0]
        covered = sum(area[part] for part in known)
        if len({named[part][0] for part in known}) < 2 or covered < SHARE * area[piece]:
            divided[piece] = (piece,)
    gains = {(a, b): _gain(a, b, divided, area, odds) for a, b in pairs}
    for a, b in sorted(pairs, key=lambda pair: -gains[pair]):
        if gains[a, b] > MERGED and a in divided and b in divided:
            del divided[a], divided[b]
            divided[a | b] = (a | b,)
    result = np.zeros(parts.shape, np.int32)
    for number, thing in enumerate((thing for division in divided.values() for thing in division), start=1):
        result[_mask(parts, thing)] = number
    return result


def _parts(frame: RGBDFrame, labels: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Return the numbers [H, W] of the parts of all pieces, 0 is background, and the piece of each part [n + 1]."""
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
    """Return the numbers [H, W] of the large connected parts of clusters; the rest of a mask goes to the nearest."""
    numbers = np.zeros(clusters.shape, np.int32)
    for cluster in range(1, count + 1):
        here, _ = components(clusters == cluster)
        numbers = np.where(here > 0, here + numbers.max(), numbers)
    sizes = label_sizes(numbers, int(numbers.max()) + 1)
    sizes[0] = 0
    large = np.argsort(-sizes, kind="stable")[:MOST_PARTS]
    kept = large[sizes[large] >= min(LEAST_PART // 4, sizes.max())]
    rank = np.zeros(len(sizes), np.int32)
    rank[kept] = np.arange(1, len(kept) + 1)
    known = rank[numbers] > 0
    return np.where(mask, rank[numbers[known]].take(nearest_known(known)), 0)


def _candidates(
    parts: NDArray[np.int32], piece_of: NDArray[np.intp], pieces: Sequence[Parts]
) -> tuple[list[list[Parts]], list[tuple[Parts, Parts]]]:
    """Return the candidates in each piece, the piece itself first, and the pairs of neighbouring pieces."""
    beside: dict[int, set[int]] = {}
    touching = set()
    image = parts.astype(np.float32)
    grown = np.where(parts > 0, parts, cv2.dilate(image, np.ones((BESIDE, BESIDE), np.uint8)).astype(np.int32))
    for a, b in ((grown[:-1], grown[1:]), (grown[:, :-1], grown[:, 1:])):
        at = (a != b) & (a > 0) & (b > 0)
        for one, other in np.unique(np.stack([a[at], b[at]], axis=1), axis=0).tolist():
            if piece_of[one] == piece_of[other]:
                beside.setdefault(one, set()).add(other)
                beside.setdefault(other, set()).add(one)
            else:
                touching.add((min(piece_of[one], piece_of[other]), max(piece_of[one], piece_of[other])))
    inside = []
    for piece in pieces:
        level = {frozenset([part]) for part in piece}
        candidates = {piece, *level}
        for _ in range(MOST_JOINED - 1):
            level = {each | {other} for each in level for part in each for other in beside.get(part, set()) - each}
            candidates |= level
        inside.append([piece, *sorted(candidates - {piece}, key=sorted)])
    return inside, [(pieces[a - 1], pieces[b - 1]) for a, b in sorted(touching)]


def _mask(parts: NDArray[np.int32], candidate: Parts) -> Mask:
    wanted = np.zeros(int(parts.max()) + 1, bool)
    wanted[list(candidate)] = True
    return wanted[parts]


def _shown(frame: RGBDFrame, parts: NDArray[np.int32], candidate: Parts) -> RGBDFrame:
    """Return the part of a frame around a candidate, which has the label 1; all other parts are beside it."""
    mask = _mask(parts, candidate)
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    top, left = max(rows[0] - MARGIN, 0), max(columns[0] - MARGIN, 0)
    here = np.s_[top : rows[-1] + MARGIN + 1, left : columns[-1] + MARGIN + 1]
    labels = np.where(mask[here], 1, np.where(parts[here] > 0, parts[here] + 1, 0))
    camera = frame.intrinsics
    moved = dataclasses.replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=None, height=None)
    return RGBDFrame(frame.color[here], frame.depth[here], labels, moved)


def _log_odds(name: str | None, confidence: float) -> float:
    """Return the log-odds of the confidence of an answer, 0 if it does not count."""
    return 0.0 if name is None or confidence < LEAST else float(logit(min(confidence, MOST)))


def _best_division(
    piece: Parts, candidates: Sequence[Parts], area: dict[Parts, int], odds: dict[Parts, float]
) -> tuple[Parts, ...]:
    """Return the division of a piece into candidates with the largest sum of area times log-odds, less the costs."""
    cost = COST * area[piece]

    @functools.cache
    def best(left: Parts) -> tuple[float, tuple[Parts, ...]]:
        if not left:
            return 0.0, ()
        first, results = min(left), []
        for candidate in candidates:
            if first in candidate and candidate <= left:
                value, others = best(left - candidate)
                results.append((value + area[candidate] * odds[candidate] - cost, (candidate, *others)))
        return max(results, key=lambda result: result[0])

    return best(piece)[1]


def _gain(
    a: Parts, b: Parts, divided: dict[Parts, tuple[Parts, ...]], area: dict[Parts, int], odds: dict[Parts, float]
) -> float:
    apart = sum(area[thing] * odds[thing] for piece in (a, b) for thing in divided[piece])
    return odds[a | b] - apart / area[a | b]
