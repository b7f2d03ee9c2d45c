"""Values of an evaluation: breakdown by attributes, statistics over runs, confidence metrics, and placements.

A placement is an object that does not move in neighbouring frames of a video. Such frames are nearly equal, so their
answers are not independent. Therefore, accuracy is also averaged over placements, and the answers within a placement
show how steady a recognizer is.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import roc_auc_score

from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.readers.labelled import sequence_of

__all__ = [
    "COVERAGE",
    "Flags",
    "Floats",
    "accuracy_at_coverage",
    "attribute_tables",
    "auroc",
    "expected_calibration_error",
    "find_placements",
    "group_by_attributes",
    "placement_accuracy",
    "reliability",
    "steadiness",
    "summarize_rows",
    "summarize_runs",
    "unknown_named",
]

COVERAGE = 0.95
"""Fraction of the answers to known objects, or of the correct ones, that is accepted in the open-set metrics."""

BINS = 15
"""Number of confidence bins of equal width, the usual value in the literature."""


Floats = NDArray[np.floating[Any]]
Flags = NDArray[np.bool_]


def reliability(confidence: Floats, correct: Flags) -> dict[str, NDArray[Any]]:
    """Return accuracy and mean confidence of each bin; bin k holds k/15 < confidence <= (k+1)/15, the first also 0.

    Args:
        confidence: [N], from 0 to 1.
        correct: [N], whether the answer is correct.

    Returns:
        "answers" [bins] int, number of answers in each bin; and "accuracy" and "confidence" [bins], the fraction of
        these answers that are correct and their mean confidence, NaN in empty bins.
    """
    values = np.asarray(confidence, np.float64)
    number = np.clip(np.ceil(values * BINS).astype(np.intp) - 1, 0, BINS - 1)
    count = np.bincount(number, minlength=BINS)
    with np.errstate(invalid="ignore"):
        accuracy = np.bincount(number, correct, BINS) / count
        mean = np.bincount(number, values, BINS) / count
    return {"answers": count, "accuracy": accuracy, "confidence": mean}


def expected_calibration_error(confidence: Floats, correct: Flags) -> float:
    """Return the mean over the answers of |accuracy - confidence| of their bin; NaN without answers.

    See Guo et al., "On Calibration of Modern Neural Networks" (ICML 2017). The arguments are as in `reliability`.
    """
    values = reliability(confidence, correct)
    used = values["answers"] > 0
    if not used.any():
        return math.nan
    differences = np.abs(values["accuracy"] - values["confidence"])
    return float(np.average(differences[used], weights=values["answers"][used]))


def auroc(confidence: Floats, positive: Flags) -> float:
    """Return the area under the ROC curve, the probability that a positive has a higher confidence than a negative.

    Args:
        confidence: [N], from 0 to 1.
        positive: [N], for instance whether the answer is correct, or whether the object is known.

    Returns:
        The area; NaN if all are positive or all are negative.
    """
    return float(roc_auc_score(positive, confidence)) if 0 < positive.sum() < len(positive) else math.nan


def accuracy_at_coverage(confidence: Floats, correct: Flags) -> tuple[float, float]:
    """Return the accuracy of the most confident answers, a fraction `COVERAGE` of all.

    Returns:
        The smallest confidence that is accepted, and the accuracy of the accepted answers; NaN without answers.
    """
    if not len(confidence):
        return math.nan, math.nan
    threshold = _threshold(confidence, COVERAGE)
    return float(threshold), float(correct[confidence >= threshold].mean())


def _threshold(confidence: Floats, kept: ArrayLike) -> NDArray[np.float64]:
    """Return the largest thresholds that keep fractions `kept` [...] of the confidences; infinity keeps nothing."""
    # 0.28 * 25 is slightly more than 7 in floating point.
    count = np.ceil(np.round(np.asarray(kept) * len(confidence), 9)).astype(np.intp)
    return np.append(np.sort(confidence), np.inf)[len(confidence) - count]


def unknown_named(correct: Floats, unknown: Floats, kept: ArrayLike = COVERAGE) -> NDArray[np.float64]:
    """Return the fraction of unknown objects named at the threshold that keeps a fraction `kept` of correct answers.

    The threshold is the largest confidence that keeps at least this fraction; answers equal to it are kept.

    Args:
        correct: [N], confidences of the correct answers.
        unknown: [M], confidences of the answers to unknown objects.
        kept: [...], from 0 to 1.

    Returns:
        [...] fractions; NaN if there is no correct answer or no unknown object.
    """
    if not len(correct) or not len(unknown):
        return np.full(np.shape(kept), np.nan)
    return np.asarray((unknown >= _threshold(correct, kept)[..., None]).mean(axis=-1))


_ORDER = {"none": 0, "low": 1, "high": 2}

_TABLES: dict[str, tuple[tuple[str, ...], ...]] = {
    "uwis": (("environment",), ("environment", "category"), ("environment", "occlusion"), ("environment", "light")),
    "ocid": (("camera",), ("camera", "place"), ("camera", "type"), ("camera", "place", "type"), ("sequence",)),
}
"""Attributes of the paper's tables for its two datasets."""


def attribute_tables(kind: str, attributes: Sequence[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """Return the attributes of each table: none for the first, then those of the paper's tables or each one alone."""
    known = sorted({name for each in attributes for name in each})
    tables = _TABLES.get(kind, tuple((name,) for name in known))
    return [(), *(table for table in tables if set(table) <= set(known))]


def group_by_attributes(
    attributes: Sequence[Mapping[str, str]], names: Sequence[str]
) -> dict[tuple[str, ...], NDArray[np.intp]]:
    """Return the indices for each combination of values of the attributes; entries that lack one are left out."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for index, each in enumerate(attributes):
        if all(name in each for name in names):
            groups.setdefault(tuple(each[name] for name in names), []).append(index)
    ordered = sorted(groups, key=lambda values: [(_ORDER.get(value, -1), value) for value in values])
    return {values: np.array(groups[values], np.intp) for values in ordered}


def summarize_runs(values: Sequence[float | None]) -> dict[str, Any]:
    """Return the statistics of a value over several runs as a JSON table.

    `runs` is the number of runs with a finite value, `mean` their mean (None if there are none), and `std` their sample
    standard deviation (n - 1; None for fewer than two).
    """
    finite = np.array(values, np.float64)  # None becomes NaN
    finite = finite[np.isfinite(finite)]
    return {
        "mean": float(finite.mean()) if len(finite) else None,
        "std": float(finite.std(ddof=1)) if len(finite) > 1 else None,
        "runs": len(finite),
    }


def summarize_rows(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return `summarize_runs` of every value in the rows, one row per run with the same names; at least one row."""
    return {name: summarize_runs([row[name] for row in rows]) for name in rows[0]}


MAX_MOVE = 0.03
"""Largest distance between the positions of an unmoved object in two neighbouring frames, metres."""

MIN_UNMOVED = 0.75
"""Smallest fraction of unmoved objects in each of two frames; with fewer, the objects count as rearranged."""


def find_placements(frames: Sequence[FrameAnswers]) -> list[NDArray[np.intp]]:
    """Return the placement of every labelled instance: one array for each frame, in the order of its instances.

    An instance continues the placement of the nearest instance with the same name in the previous frame under three
    conditions: both frames belong to one sequence (the identifier without its last part), the distance is at most
    `MAX_MOVE`, and this is true for at least `MIN_UNMOVED` of the instances of each frame. Instances without a position
    start a new placement.

    Args:
        frames: frames in the order of the dataset.

    Returns:
        The numbers of the placements, counted from 0 over all frames.
    """
    numbers: list[NDArray[np.intp]] = []
    new = itertools.count()
    for index, frame in enumerate(frames):
        unmoved = {}
        if index and sequence_of(frames[index - 1].frame) == sequence_of(frame.frame):
            unmoved = _unmoved(frames[index - 1].instances, frame.instances)
        own = [numbers[-1][unmoved[k]] if k in unmoved else next(new) for k in range(len(frame.instances))]
        numbers.append(np.array(own, np.intp))
    return numbers


def _unmoved(before: Sequence[InstancePrediction], now: Sequence[InstancePrediction]) -> dict[int, int]:
    """Return the indices of unmoved instances: now -> before; empty if the objects count as rearranged.

    The instances have the same name and are at most `MAX_MOVE` apart; the nearest pairs have precedence.
    """
    distances = [
        (float(np.linalg.norm(np.subtract(a.position, b.position))), i, j)
        for i, a in enumerate(before)
        for j, b in enumerate(now)
        if a.truth == b.truth and a.position is not None and b.position is not None
    ]
    unmoved: dict[int, int] = {}
    for distance, i, j in sorted(distances):
        if distance <= MAX_MOVE and j not in unmoved and i not in unmoved.values():
            unmoved[j] = i
    return unmoved if len(unmoved) >= MIN_UNMOVED * max(len(before), len(now)) else {}


def placement_accuracy(placement: NDArray[np.intp], correct: Flags) -> float:
    """Return the mean over placements of the fraction of correct instances in each; NaN without instances.

    Args:
        placement: [N] int, the placement of each instance.
        correct: [N], whether the answer is correct.
    """
    numbers = np.unique(placement, return_inverse=True)[1]
    return float((np.bincount(numbers, correct) / np.bincount(numbers)).mean()) if len(numbers) else math.nan


def steadiness(placement: NDArray[np.intp], answer: NDArray[np.intp]) -> float:
    """Return the fraction of instances that have the most frequent answer of their placement.

    Args:
        placement: [N] int, the placement of each instance. Placements with a single instance are ignored.
        answer: [N] int, the answer for each instance; all instances without an answer have the same number.

    Returns:
        The fraction; NaN if no placement has two instances.
    """
    sizes = np.bincount(placement)
    pairs, counts = np.unique(np.stack([placement, answer]), axis=1, return_counts=True)
    agreeing = np.zeros_like(sizes)
    np.maximum.at(agreeing, pairs[0], counts)
    several = sizes > 1
    return float(agreeing[several].sum() / sizes[several].sum()) if several.any() else math.nan
