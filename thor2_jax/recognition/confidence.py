"""Confidence: the estimated probability that an answer is correct, comparable between known and unknown objects.

The fused probability of a class says which of the trained classes is most likely, not whether the object is one of them
at all. The embedding of a run is also fitted on distractors, objects that are none of the classes. A logistic function
of both, fitted by `training` on views that no classifier was trained on, is the confidence.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from thor2_jax.errors import InputError

__all__ = ["Calibration", "answer_features"]

Probabilities = NDArray[np.floating[Any]]

MAX_ODDS = 8.0
"""Largest absolute log-odds of a feature; beyond it, probabilities of networks say nothing more."""


def answer_features(fused: Probabilities, embedding: Probabilities) -> NDArray[np.float64]:
    """Return the features [B, 2] of a calibration: the log-odds of the answer, fused and by the embedding alone.

    Args:
        fused: [B, C] fused class probabilities.
        embedding: [B, C] class probabilities of the embedding; what they lack to 1 is that of the distractors.
    """
    answer = fused.argmax(axis=1)[:, None]
    values = [np.take_along_axis(p, answer, axis=1)[:, 0].astype(np.float64) for p in (fused, embedding)]
    return logit(np.stack(values, axis=1).clip(0, 1)).clip(-MAX_ODDS, MAX_ODDS)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A fitted confidence.

    Attributes:
        bias: log-odds of a correct answer where both features are 0.
        answer: factor of the fused log-odds of the answer.
        known: factor of the embedding's log-odds of the answer, against all other classes and the distractors.
        unknown_below: confidence that 95 % of the correct held-out answers reach.

    Raises:
        InputError: a value is not a finite number, or `unknown_below` is not between 0 and 1.
    """

    bias: float
    answer: float
    known: float
    unknown_below: float

    def __post_init__(self) -> None:
        values = dataclasses.astuple(self)
        if not all(isinstance(value, float) and np.isfinite(value) for value in values):
            raise InputError(f"calibration is {values}; expected four finite numbers")
        if not 0 <= self.unknown_below <= 1:
            raise InputError(f"calibration: unknown_below is {self.unknown_below}; expected a confidence from 0 to 1")

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> "Calibration | None":
        """Return the calibration in the record of a run; None if it has none.

        Raises:
            InputError: it is damaged.
        """
        stored = record.get("calibration")
        if stored is None:
            return None
        try:
            return cls(**stored)
        except TypeError:
            raise InputError(f"calibration is {stored!r}; expected bias, answer, known and unknown_below") from None

    def confidence(self, fused: Probabilities, embedding: Probabilities) -> NDArray[np.float64]:
        """Return the confidence [B] of the most probable class; the arguments are those of `answer_features`."""
        features = answer_features(fused, embedding)
        return np.asarray(expit(self.bias + features @ np.array([self.answer, self.known])))

    def calibrated(self, fused: Probabilities, embedding: Probabilities) -> Probabilities:
        """Return the class probabilities [B, C], scaled so that the largest one is the confidence."""
        largest = np.maximum(fused.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
        return fused / largest * self.confidence(fused, embedding)[:, None]
