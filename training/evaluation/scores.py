"""Values of an evaluation: its breakdown by attributes, statistics over runs, confidence metrics, and placements.

A placement is an object that does not move in neighbouring frames of a video. Such frames are nearly equal, so that
their answers are not independent. Accuracy is therefore also averaged over placements, and the answers within a
placement show how steady a recognizer is.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import roc_auc_score

from thor2_jax.errors import InputError
from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.readers.labelled import sequence_of

__all__ = [
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

BINS = 15
"""Number of confidence bins of equal width, the usual value in the literature."""


class Reliability(NamedTuple):
    """Accuracy by confidence.

    Attributes:
        answers: [bins] int, number of answers in each bin.
        accuracy: [bins], fraction of them that is correct; NaN in empty bins.
        confidence: [bins], their mean confidence; NaN in empty bins.
    """

    answers: NDArray[np.intp]
    accuracy: NDArray[np.float64]
    confidence: NDArray[np.float64]


def _check(confidence: ArrayLike, flags: ArrayLike, name: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    values, marks = np.asarray(confidence, np.float64), np.asarray(flags)
    if values.ndim != 1 or values.shape != marks.shape:
        raise InputError(f"confidence and {name} have shapes {values.shape} and {marks.shape}; expected [N] and [N]")
    if not np.all((values >= 0) & (values <= 1 + 1e-6)):
        raise InputError(f"confidence has values from {values.min()} to {values.max()}; expected 0 to 1")
    return values, marks.astype(bool)


def reliability(confidence: ArrayLike, correct: ArrayLike, bins: int = BINS) -> Reliability:
    """Return accuracy and mean confidence of each bin; bin k holds k/bins < confidence <= (k+1)/bins, the first also 0.

    Args:
        confidence: [N], from 0 to 1.
        correct: [N], whether the answer is correct.
        bins: number of bins.

    Raises:
        InputError: the shapes do not match, or a confidence is outside 0 to 1.
    """
    values, marks = _check(confidence, correct, "correct")
    number = np.clip(np.ceil(values * bins).astype(np.intp) - 1, 0, bins - 1)
    count = np.bincount(number, minlength=bins)
    with np.errstate(invalid="ignore"):
        accuracy = np.bincount(number, marks, bins) / count
        mean = np.bincount(number, values, bins) / count
    return Reliability(count, accuracy, mean)


def expected_calibration_error(confidence: ArrayLike, correct: ArrayLike) -> float:
    """Return the mean over the answers of |accuracy - confidence| of their bin; NaN without answers.

    Guo et al., "On Calibration of Modern Neural Networks" (ICML 2017). The arguments and errors are those of
    `reliability`.
    """
    values = reliability(confidence, correct)
    used = values.answers > 0
    if not used.any():
        return math.nan
    return float(np.average(np.abs(values.accuracy - values.confidence)[used], weights=values.answers[used]))


def auroc(confidence: ArrayLike, positive: ArrayLike) -> float:
    """Return the area under the ROC curve, the probability that a positive has a higher confidence than a negative.

    Args:
        confidence: [N], from 0 to 1.
        positive: [N], for instance whether the answer is correct, or whether the object is known.

    Returns:
        The area; NaN if all are positive or all are negative.

    Raises:
        InputError: the shapes do not match, or a confidence is outside 0 to 1.
    """
    values, marks = _check(confidence, positive, "positive")
    return float(roc_auc_score(marks, values)) if 0 < marks.sum() < len(marks) else math.nan


class Coverage(NamedTuple):
    """The most confident answers; the others are rejected as unknown objects.

    Attributes:
        threshold: smallest confidence that is accepted.
        kept: fraction of the answers that is accepted; more than the requested coverage where confidences are equal.
        accuracy: accuracy of the accepted answers.
    """

    threshold: float
    kept: float
    accuracy: float


def accuracy_at_coverage(confidence: ArrayLike, correct: ArrayLike, coverage: float = 0.95) -> Coverage:
    """Return the accuracy if at least a fraction `coverage` of the answers is accepted; NaN without answers.

    Raises:
        InputError: the shapes do not match, a confidence is outside 0 to 1, or `coverage` is not in (0, 1].
    """
    values, marks = _check(confidence, correct, "correct")
    if not 0 < coverage <= 1:
        raise InputError(f"coverage is {coverage}; expected a number above 0 and at most 1")
    if not len(values):
        return Coverage(math.nan, math.nan, math.nan)
    accepted = math.ceil(round(coverage * len(values), 9))  # 0.95 * 20 is slightly more than 19 in floating point
    threshold = np.sort(values)[len(values) - accepted]
    kept = values >= threshold
    return Coverage(float(threshold), float(kept.mean()), float(marks[kept].mean()))


def unknown_named(correct: ArrayLike, unknown: ArrayLike, kept: ArrayLike = 0.95) -> NDArray[np.float64]:
    """Return the share of unknown objects that are named where a share `kept` of the correct answers is kept.

    The threshold is the largest confidence that keeps at least this share; an answer with this confidence is kept.

    Args:
        correct: [N], confidences of the correct answers.
        unknown: [M], confidences of the answers to unknown objects.
        kept: [...], from 0 to 1.

    Returns:
        [...] shares; NaN if there is no correct answer or no unknown object.

    Raises:
        InputError: `kept` is not from 0 to 1.
    """
    ordered, others, shares = np.sort(np.asarray(correct, np.float64)), np.asarray(unknown), np.asarray(kept)
    if not np.all((shares >= 0) & (shares <= 1)):
        raise InputError(f"kept has values from {shares.min()} to {shares.max()}; expected 0 to 1")
    if not len(ordered) or not len(others):
        return np.full(shares.shape, np.nan)
    # 0.95 * 20 is slightly more than 19 in floating point. Keeping nothing takes a threshold above all confidences.
    count = np.ceil(np.round(shares * len(ordered), 9)).astype(np.intp)
    threshold = np.append(ordered, np.inf)[len(ordered) - count]
    return np.asarray((others >= threshold[..., None]).mean(axis=-1))


_ORDER = {"none": 0, "low": 1, "high": 2}

_TABLES: dict[str, tuple[tuple[str, ...], ...]] = {
    "uwis": (("environment",), ("environment", "category"), ("environment", "occlusion"), ("environment", "light")),
    "ocid": (("camera",), ("camera", "place"), ("camera", "type"), ("camera", "place", "type"), ("sequence",)),
}
"""Attributes of the paper's tables for its two datasets."""


def attribute_tables(kind: str, attributes: Sequence[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """Return the attributes of each table: none for the first, then the paper's tables or each attribute by itself."""
    known = sorted({name for each in attributes for name in each})
    tables = _TABLES.get(kind, tuple((name,) for name in known))
    return [(), *(table for table in tables if set(table) <= set(known))]


def group_by_attributes(
    attributes: Sequence[Mapping[str, str]], names: Sequence[str]
) -> dict[tuple[str, ...], NDArray[np.intp]]:
    """Return the indices for each combination of the named attributes' values; entries that lack one are left out."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for index, each in enumerate(attributes):
        if all(name in each for name in names):
            groups.setdefault(tuple(each[name] for name in names), []).append(index)
    ordered = sorted(groups, key=lambda values: [(_ORDER.get(value, -1), value) for value in values])
    return {values: np.array(groups[values], np.intp) for values in ordered}


def summarize_runs(values: Sequence[float]) -> dict[str, Any]:
    """Return the statistics of a value over several runs as a JSON table.

    They are the `mean` over the runs that have a finite value, None if none has; the sample standard deviation (n - 1)
    `std`, None for fewer than two; and the number of these `runs`.
    """
    finite: NDArray[Any] = np.array([value for value in values if np.isfinite(value)])
    return {
        "mean": float(finite.mean()) if len(finite) else None,
        "std": float(finite.std(ddof=1)) if len(finite) > 1 else None,
        "runs": len(finite),
    }


def summarize_rows(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return `summarize_runs` of every value of the runs' rows, which have the same names; at least one row."""
    return {name: summarize_runs([row[name] for row in rows]) for name in rows[0]}


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
