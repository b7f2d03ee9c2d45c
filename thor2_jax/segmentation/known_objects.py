"""Refinement of a segmentation by recognition, since objects in a pile touch without a visible edge.

labels = segment_known(frame, labels, recognize, locate)  # labels of `segment_table`, [H, W]

Objects are taken from each piece of the segmentation one by one. What is left of the piece is divided into parts of
similar colour and place. The parts, unions of neighbouring parts and all of it are candidates and are recognized. The
best one is the next object. If its surface is known, pixels whose points lie on the surface are added to it, and others
are removed. If fewer than two names were found in a piece, or too little of it is known, the piece remains. Neighbours
are then merged repeatedly if their union is recognized better than each of them. In the end, pixels go to the object on
whose surface their points lie. Large images are divided at a lower resolution.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from thor2_jax.frames.frames import RGBDFrame, backproject
from thor2_jax.segmentation.pixels import Mask, components, enlarged, filled, grow, renumbered, subsampled, window

__all__ = ["Distances", "fit_masks", "segment_known"]

Parts = frozenset[int]
"""Numbers of the parts of a candidate, or of the pieces that are merged."""

Answer = tuple[str | None, float]
"""Name (None for an unknown object) and confidence."""

Recognize = Callable[[Sequence[RGBDFrame]], Sequence[Answer]]
"""Function from frames to the answer for the instance with label 1 in each frame; other labels are neighbours."""

Distances = Callable[[NDArray[np.floating]], NDArray[np.float64]]
"""Function from points [n, 3] in the camera frame to their distances [n] from the surface of an object, metres."""

Locate = Callable[[RGBDFrame], Mapping[int, Distances]]
"""Function from a frame with labels to label -> distances from the surface, for all known objects."""

WORKING_SIZE = 640
"""Larger side, pixels, of the images that are divided; images of at least twice this size are subsampled."""

LEAST_PART, MOST_PARTS = 1000, 6
"""Smallest average number of pixels of a part, and largest number of parts of a region."""

MOST_JOINED = 4
"""Largest number of parts in a candidate that is not the whole region."""

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

GAIN = 1.0
"""Smallest increase of the log-odds of a known object when two objects are merged."""

ROUNDS = 2
"""Number of times that surfaces are fitted to masks, and masks to surfaces."""

ON_SURFACE, OFF_SURFACE = 0.008, 0.015
"""A point within ON_SURFACE of another object can go to it; a point beyond OFF_SURFACE leaves its object; metres."""

LEAST_PIXELS = 200
"""Number of pixels of the smallest separate piece; smaller ones stay, or go to the nearest piece."""


def segment_known(
    frame: RGBDFrame, labels: NDArray[np.integer], recognize: Recognize, locate: Locate
) -> NDArray[np.int32]:
    """Return labels after pieces are divided and merged where the results are known objects.

    Args:
        frame: colour, depth and intrinsics; its labels are not read.
        labels: [H, W] integers, for example from `segment_table`; 0 is background.
        recognize: see `Recognize`.
        locate: see `Locate`.

    Returns:
        Labels [H, W]: 0 is background, and the objects are numbered from 1.
    """
    if (stride := max(labels.shape) // WORKING_SIZE) > 1:
        small = segment_known(subsampled(frame, stride), labels[::stride, ::stride], recognize, locate)
        return fit_masks(frame, enlarged(small, stride, labels.shape), locate)
    divided, features = np.zeros(labels.shape, np.int32), _features(frame)
    values = np.unique(labels[labels > 0])  # renumbered from 1, so that numbers of parts can be added to any label
    labels = np.where(labels > 0, np.searchsorted(values, labels) + 1, 0).astype(np.int32)
    for label in range(1, len(values) + 1):
        objects = _divided(frame, features, labels, label, recognize, locate)
        divided = np.where(objects > 0, objects + divided.max(), divided)
    beside, known = _neighbours(divided), _Known(frame, divided, recognize)
    things = {frozenset([number]) for number in beside}
    while merged := _merged(things, beside, known):
        things = merged
    number_of = np.zeros(divided.max() + 1, np.int32)
    for thing in things:
        number_of[list(thing)] = min(thing)
    return fit_masks(frame, number_of[divided], locate)


def fit_masks(frame: RGBDFrame, labels: NDArray[np.int32], locate: Locate) -> NDArray[np.int32]:
    """Return labels that fit the surfaces of known objects.

    A pixel of an object, or beside one, goes to the known object whose surface is nearest to its point, if that is
    within `ON_SURFACE`. Pixels farther than `OFF_SURFACE` from the surface of their known object become a piece if at
    least `LEAST_PIXELS` of them are connected. Otherwise, pieces of unknown objects do not change.

    Args:
        frame: colour, depth and intrinsics; its labels are not read.
        labels: [H, W]; 0 is background, every other number an object.
        locate: see `Locate`.

    Returns:
        Labels [H, W]: 0 is background, and the objects are numbered from 1.
    """
    region = grow(labels > 0, 3)  # by one pixel
    for _ in range(ROUNDS):
        surfaces = locate(dataclasses.replace(frame, labels=labels))
        if not surfaces:
            break
        labels = _fitted(frame, labels, surfaces, region)
    return renumbered(labels, np.bincount(labels[labels > 0], minlength=1) > 0)[0]


def _fitted(
    frame: RGBDFrame, labels: NDArray[np.int32], surfaces: Mapping[int, Distances], region: Mask
) -> NDArray[np.int32]:
    """Return labels after one round of `fit_masks` inside a region; new pieces have new numbers, others keep theirs."""
    known, at = np.array(list(surfaces)), region & (frame.depth_m > 0)
    points = frame.points(np.flatnonzero(at))
    distance = np.stack([distances(points) for distances in surfaces.values()])  # [known, n]
    is_own = known[:, None] == labels[at]
    own, nearest = np.where(is_own, distance, np.inf).min(axis=0), distance.min(axis=0)
    moves, leaves = (nearest < ON_SURFACE) & (nearest < own), is_own.any(axis=0) & (own > OFF_SURFACE)
    rest = int(labels.max()) + 1
    fitted = np.where(np.isin(labels, known), 0, labels)  # pixels of known objects without depth follow later
    fitted[at] = np.select([moves, leaves], [known[distance.argmin(axis=0)], rest], labels[at])
    tidied = np.zeros_like(labels)  # without small separate pieces of changed objects
    for label in np.unique(fitted[fitted > 0]):
        mask = fitted == label
        numbers, sizes = components(mask)
        least = min(LEAST_PIXELS, sizes.max()) if (mask != (labels == label)).any() else 1
        numbers, _ = renumbered(numbers, sizes >= (LEAST_PIXELS if label == rest else least), label - 1)
        tidied += numbers if label == rest else np.minimum(numbers, label)
    tidied = np.where((fitted == rest) & (tidied == 0), labels, tidied)  # too few for a piece: they stay
    return filled(tidied, (labels > 0) | (tidied > 0))


class _Known:
    """Recognized candidates among the parts of an image.

    Attributes:
        name: candidate -> name, None for an unknown object.
        odds: candidate -> log-odds of the confidence, 0 for an unknown object.
    """

    def __init__(self, frame: RGBDFrame, parts: NDArray[np.int32], recognize: Recognize) -> None:
        self.name: dict[Parts, str | None] = {}
        self.odds: dict[Parts, float] = {}
        self._frame, self._parts, self._recognize = frame, parts, recognize

    def look_at(self, candidates: Sequence[Parts]) -> None:
        """Recognize the new candidates in one call."""
        new = [each for each in dict.fromkeys(candidates) if each not in self.odds]
        for each, (name, confidence) in zip(new, self._recognize([*map(self._shown, new)]), strict=True):
            counts = name is not None and confidence >= LEAST
            self.name[each] = name if counts else None
            self.odds[each] = float(logit(min(confidence, MOST))) if counts else 0.0

    def _shown(self, candidate: Parts) -> RGBDFrame:
        """Return the section of the frame around a candidate, which has the label 1; other parts have higher labels."""
        mask = _mask(self._parts, candidate)
        here = window(mask, MARGIN)
        parts, camera = self._parts[here], self._frame.intrinsics
        labels = np.where(mask[here], 1, np.where(parts > 0, parts + 1, 0))
        cx, cy = camera.cx - here[1].start, camera.cy - here[0].start
        moved = dataclasses.replace(camera, cx=cx, cy=cy, width=None, height=None)
        return RGBDFrame(self._frame.color[here], self._frame.depth[here], labels, moved)


def _divided(
    frame: RGBDFrame,
    features: NDArray[np.float32],
    labels: NDArray[np.integer],
    label: int,
    recognize: Recognize,
    locate: Locate,
) -> NDArray[np.int32]:
    """Return the objects of a piece, and what is left of it, numbered from 1 [H, W]; 0 outside the piece.

    The next object is the candidate with the largest product of its log-odds and its number of pixels. If fewer than
    two names are found, or objects cover less than `SHARE` of the piece, all of it has number 1.
    """
    piece = labels == label
    regions: list[Mask] = [piece]
    objects: list[Mask] = []
    left: list[Mask] = []
    names = set()
    while regions:
        region = regions.pop()
        parts = _parts(features, region)
        known = _Known(frame, np.where((labels > 0) & ~region, labels + parts.max(), parts), recognize)
        candidates = _candidates(_neighbours(parts))
        known.look_at(candidates)
        sizes = np.bincount(parts.ravel())
        best = max(candidates, key=lambda each: known.odds[each] * sizes[list(each)].sum())
        if known.name[best] is None:
            left.append(region)
            continue
        mask = _mask(parts, best)
        if surfaces := locate(dataclasses.replace(frame, labels=mask.astype(np.int32))):
            fitted = _fitted(frame, np.where(mask, 1, np.where(region, 2, 0)).astype(np.int32), surfaces, region) == 1
            mask = fitted if fitted.sum() >= LEAST_PIXELS else mask
        names.add(known.name[best])
        objects.append(mask)
        numbers, sizes = components(region & ~mask)
        regions += [numbers == number for number in np.flatnonzero(sizes >= LEAST_PIXELS)]
    if len(names) < 2 or np.any(objects, axis=0).sum() < SHARE * piece.sum():
        return piece.astype(np.int32)
    result = np.zeros(piece.shape, np.int32)
    for number, mask in enumerate([*objects, *left], start=1):
        result[mask] = number
    return filled(result, piece)


def _features(frame: RGBDFrame) -> NDArray[np.float32]:
    """Return colours and places [H, W, 6], in units of `CELL`."""
    lab = np.asarray(cv2.cvtColor(cv2.medianBlur(frame.color, SMOOTH), cv2.COLOR_RGB2LAB), np.float32)
    points = backproject(frame.depth_m, frame.intrinsics)
    return np.dstack([lab * np.array([0.6, 1, 1], np.float32) / CELL[0], points / CELL[1]]).astype(np.float32)


def _parts(features: NDArray[np.float32], region: Mask) -> NDArray[np.int32]:
    """Return the part of each pixel [H, W] of a region, numbered from 1; 0 outside the region."""
    known = region & (features[..., 5] > 0)  # with depth
    count = min(int(known.sum()) // LEAST_PART, MOST_PARTS)
    if count < 2:
        return region.astype(np.int32)
    cv2.setRNGSeed(0)  # equal frames get equal labels
    stop = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 20, 1e-3)
    start = np.zeros((int(known.sum()), 1), np.int32)
    _, cluster, _ = cv2.kmeans(features[known], count, start, stop, 1, cv2.KMEANS_PP_CENTERS)
    clusters = np.zeros(region.shape, np.int32)
    clusters[known] = np.asarray(cluster).ravel() + 1
    return _connected(clusters, region, count)


def _connected(clusters: NDArray[np.int32], mask: Mask, count: int) -> NDArray[np.int32]:
    """Return the numbers [H, W] of large connected parts of clusters; other pixels of the mask get the nearest part."""
    numbers = np.zeros(clusters.shape, np.int32)
    for cluster in range(1, count + 1):
        here, _ = components(clusters == cluster)
        numbers = np.where(here > 0, here + numbers.max(), numbers)
    sizes = np.bincount(numbers[numbers > 0])
    large = np.argsort(-sizes, kind="stable")[:MOST_PARTS]
    kept = large[sizes[large] >= min(LEAST_PART // 4, sizes.max())]
    rank = np.zeros(len(sizes), np.int32)
    rank[kept] = np.arange(1, len(kept) + 1)
    return filled(rank[numbers], mask)


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


def _candidates(beside: dict[int, set[int]]) -> list[Parts]:
    """Return the candidates in a region, given the neighbours of its parts; the region itself is the first."""
    region = frozenset(beside)
    level = {frozenset([part]) for part in region}
    candidates = {region, *level}
    for _ in range(MOST_JOINED - 1):
        level = {each | {other} for each in level for part in each for other in beside[part] - each}
        candidates |= level
    return [region, *sorted(candidates - {region}, key=sorted)]


def _mask(parts: NDArray[np.int32], candidate: Parts) -> Mask:
    return np.isin(np.arange(parts.max() + 1), list(candidate))[parts]


def _merged(things: set[Parts], beside: dict[int, set[int]], known: _Known) -> set[Parts]:
    """Return objects after neighbours are merged where a known object gains; an empty set if nothing is merged."""
    at = {part: thing for thing in things for part in thing}
    touching = {(at[part], at[other]) for part in at for other in beside[part] if min(at[part]) < min(at[other])}
    known.look_at(sorted({thing for pair in touching for thing in pair}, key=min))
    pairs = [(a, b) for a, b in touching if len({known.name[a], known.name[b]} - {None}) < 2]
    pairs.sort(key=lambda pair: [min(each) for each in pair])
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
