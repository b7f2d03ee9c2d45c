"""Placements: an object that does not move in neighbouring frames of a video is one placement.

Neighbouring frames of a video are nearly equal, so that their answers are not independent. Accuracy is therefore also
averaged over placements, and the answers within a placement show how steady a recognizer is.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.readers.labelled import sequence_of

__all__ = ["MAX_MOVE", "MIN_UNMOVED", "find_placements", "placement_accuracy", "steadiness"]

MAX_MOVE = 0.03
"""Largest distance between the positions of an unmoved object in two neighbouring frames, metres."""

MIN_UNMOVED = 0.75
"""Smallest share of the objects of either frame that are unmoved; with fewer, the objects were arranged anew."""


def find_placements(frames: Sequence[FrameAnswers]) -> list[NDArray[np.intp]]:
    """Return the placement of every labelled instance: one array for each frame, in the order of its instances.

    An instance continues the placement of the nearest instance of the same name in the frame before if both frames
    belong to one sequence (the identifier without its last part), they are at most `MAX_MOVE` apart, and this holds for
    at least `MIN_UNMOVED` of the instances of either frame. Instances without a position continue nothing.

    Args:
        frames: frames in the order of the dataset.

    Returns:
        Numbers of the placements, counted from 0 over all frames.
    """
    numbers: list[NDArray[np.intp]] = []
    count = 0
    for index, frame in enumerate(frames):
        before = frames[index - 1] if index else None
        own = np.full(len(frame.instances), -1, np.intp)
        if before is not None and sequence_of(before.frame) == sequence_of(frame.frame):
            pairs = _unmoved(before.instances, frame.instances)
            if pairs and len(pairs) >= MIN_UNMOVED * max(len(before.instances), len(frame.instances)):
                for previous, current in pairs:
                    own[current] = numbers[-1][previous]
        new = own < 0
        own[new] = count + np.arange(new.sum())
        count += int(new.sum())
        numbers.append(own)
    return numbers


def _unmoved(before: Sequence[InstancePrediction], now: Sequence[InstancePrediction]) -> list[tuple[int, int]]:
    """Return pairs of indices of instances with one name that are at most `MAX_MOVE` apart, the nearest ones first."""
    distances = [
        (float(np.linalg.norm(np.subtract(a.position, b.position))), i, j)
        for i, a in enumerate(before)
        for j, b in enumerate(now)
        if a.truth == b.truth and a.position is not None and b.position is not None
    ]
    pairs: list[tuple[int, int]] = []
    for distance, i, j in sorted(distances):
        if distance <= MAX_MOVE and all(i != a and j != b for a, b in pairs):
            pairs.append((i, j))
    return pairs


def placement_accuracy(placement: ArrayLike, correct: ArrayLike) -> float:
    """Return the mean over the placements of the share of their instances that are correct; NaN without instances.

    Args:
        placement: [N] int, the placement of each instance.
        correct: [N], whether the answer is correct.
    """
    numbers = np.unique(np.asarray(placement), return_inverse=True)[1]
    if not len(numbers):
        return float("nan")
    return float((np.bincount(numbers, np.asarray(correct, float)) / np.bincount(numbers)).mean())


def steadiness(placement: ArrayLike, answer: ArrayLike) -> float:
    """Return the share of instances with the most frequent answer of their placement.

    Args:
        placement: [N] int, the placement of each instance. Placements of one instance do not count.
        answer: [N] int, its answer; all instances without an answer have the same number.

    Returns:
        The share; NaN if no placement has two instances.
    """
    numbers = np.unique(np.asarray(placement), return_inverse=True)[1]
    sizes = np.bincount(numbers)
    pairs, counts = np.unique(np.stack([numbers, np.asarray(answer, np.intp)]), axis=1, return_counts=True)
    agreeing = np.zeros_like(sizes)
    np.maximum.at(agreeing, pairs[0], counts)
    several = sizes > 1
    return float(agreeing[several].sum() / sizes[several].sum()) if several.any() else float("nan")
