"""Confidence metrics: calibration error, AUROC, and accuracy at a given coverage."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import roc_auc_score

from thor2_jax.errors import InputError

__all__ = [
    "BINS",
    "Coverage",
    "Reliability",
    "accuracy_at_coverage",
    "auroc",
    "expected_calibration_error",
    "reliability",
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


def expected_calibration_error(confidence: ArrayLike, correct: ArrayLike, bins: int = BINS) -> float:
    """Return the mean over the answers of |accuracy - confidence| of their bin; NaN without answers.

    Guo et al., "On Calibration of Modern Neural Networks" (ICML 2017). Arguments and errors are those of `reliability`.
    """
    values = reliability(confidence, correct, bins)
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
