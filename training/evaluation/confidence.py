"""How far a confidence can be trusted: calibration, and refusing to answer below a threshold.

Guo et al., "On Calibration of Modern Neural Networks" (ICML 2017), for temperature and expected calibration error.
"""

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
]

BINS = 15
"""Of equal width over [0, 1], as is usual."""


class Reliability(NamedTuple):
    """Answers by confidence.

    Attributes:
        answers: [bins] int, how many in each bin.
        accuracy: [bins], share of them that is right; NaN where there is none.
        confidence: [bins], mean of theirs; NaN where there is none.
    """

    answers: NDArray[np.intp]
    accuracy: NDArray[np.float64]
    confidence: NDArray[np.float64]


def _checked(confidence: ArrayLike, flags: ArrayLike, name: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    values, marks = np.asarray(confidence, np.float64), np.asarray(flags)
    if values.ndim != 1 or values.shape != marks.shape:
        raise InputError(f"confidence and {name} have shapes {values.shape} and {marks.shape}; expected [N] and [N]")
    if not np.all((values >= 0) & (values <= 1 + 1e-6)):
        raise InputError(f"confidence has values from {values.min()} to {values.max()}; expected 0 to 1")
    return values, marks.astype(bool)


def reliability(confidence: ArrayLike, right: ArrayLike, bins: int = BINS) -> Reliability:
    """Accuracy and mean confidence of each bin; bin k holds k/bins < confidence <= (k+1)/bins, the first also 0.

    Args:
        confidence: [N], from 0 to 1.
        right: [N], whether the answer was right.
        bins: how many.

    Raises:
        InputError: shapes that do not fit, or values outside 0 to 1.
    """
    values, marks = _checked(confidence, right, "right")
    number = np.clip(np.ceil(values * bins).astype(np.intp) - 1, 0, bins - 1)
    count = np.bincount(number, minlength=bins)
    with np.errstate(invalid="ignore"):
        accuracy = np.bincount(number, marks, bins) / count
        mean = np.bincount(number, values, bins) / count
    return Reliability(count, accuracy, mean)


def expected_calibration_error(confidence: ArrayLike, right: ArrayLike, bins: int = BINS) -> float:
    """Mean over the answers of |accuracy - confidence| of their bin; NaN without answers. Raises as `reliability`."""
    found = reliability(confidence, right, bins)
    used = found.answers > 0
    if not used.any():
        return math.nan
    return float(np.average(np.abs(found.accuracy - found.confidence)[used], weights=found.answers[used]))


def auroc(confidence: ArrayLike, positive: ArrayLike) -> float:
    """Area under the ROC curve of "positive if confident"; NaN if all are of one kind.

    The chance that a positive has a larger confidence than a negative. Positive may be "right" or "a known object".

    Raises:
        InputError: shapes that do not fit, or values outside 0 to 1.
    """
    values, marks = _checked(confidence, positive, "positive")
    return float(roc_auc_score(marks, values)) if 0 < marks.sum() < len(marks) else math.nan


class Coverage(NamedTuple):
    """Answers kept, the least confident ones being called unknown.

    Attributes:
        threshold: below it an answer is "unknown".
        kept: share of the answers at or above it; more than was asked for where confidences are equal.
        accuracy: of those kept.
    """

    threshold: float
    kept: float
    accuracy: float


def accuracy_at_coverage(confidence: ArrayLike, right: ArrayLike, coverage: float = 0.95) -> Coverage:
    """Accuracy of the most confident answers, at least `coverage` of all; NaN without answers.

    Raises:
        InputError: shapes that do not fit, values outside 0 to 1, or a coverage not in (0, 1].
    """
    values, marks = _checked(confidence, right, "right")
    if not 0 < coverage <= 1:
        raise InputError(f"coverage is {coverage}; it must be above 0 and at most 1")
    if not len(values):
        return Coverage(math.nan, math.nan, math.nan)
    needed = math.ceil(round(coverage * len(values), 9))  # 0.95 * 20 is a little more than 19
    threshold = np.sort(values)[len(values) - needed]
    kept = values >= threshold
    return Coverage(float(threshold), float(kept.mean()), float(marks[kept].mean()))
