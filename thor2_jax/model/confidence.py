"""Confidence: the estimated probability that the answer to a known object is correct; low for unknown objects.

The fused probability of a class says which of the trained classes is most likely, not whether the object is one of them
at all. The embedding of a run is also fitted on distractors, objects that are none of the classes. The score of an
answer is the product of two logistic functions,

    score = P(correct | known, fused probability) P(known | the embedding's probability of all classes)

In new runs the first one is constant, since the answer to an object that looks like two classes is not one to an unknown
object. The two kinds of objects have equal weights in the fit, so that the score separates them well. The confidence is a
third logistic function, of the log-odds of the score: the share of correct answers to known objects with this score
(Platt, 1999). They are fitted by `training` on views that no network was trained on.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from thor2_jax.errors import InputError
from thor2_jax.model.run_record import stored_value

__all__ = ["MAX_ODDS", "Calibration", "answer_features"]

Probabilities = NDArray[np.floating[Any]]

MAX_ODDS = 8.0
"""Largest absolute log-odds of a feature; beyond it, probabilities of networks say nothing more."""


def answer_features(fused: Probabilities, embedding: Probabilities) -> NDArray[np.float64]:
    """Return the features [B, 2] of a calibration: log-odds of the answer, and of being any class by the embedding.

    Args:
        fused: [B, C] fused class probabilities.
        embedding: [B, C] class probabilities of the embedding; what they lack to 1 is that of the distractors.
    """
    values = [fused.max(axis=1), embedding.sum(axis=1)]
    return logit(np.stack(values, axis=1).astype(np.float64).clip(0, 1)).clip(-MAX_ODDS, MAX_ODDS)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A fitted confidence.

    Attributes:
        correct_bias: log-odds of a correct answer, for a known object whose first feature is 0.
        correct_factor: factor of the first feature, the fused log-odds of the answer; 0 in new runs.
        known_bias: log-odds of a known object where the second feature is 0.
        known_factor: factor of the second feature, the embedding's log-odds of all classes against the distractors.
        unknown_below: confidence that 95 % of the correct held-out answers reach (97 % in runs of earlier versions).
        score_bias: log-odds of a correct answer to a known object where the score is one half.
        score_factor: factor of the log-odds of the score.

    Raises:
        InputError: a value is not a finite number, or `unknown_below` is not between 0 and 1.
    """

    correct_bias: float
    correct_factor: float
    known_bias: float
    known_factor: float
    unknown_below: float
    score_bias: float = 0.0
    score_factor: float = 1.0

    def __post_init__(self) -> None:
        values = dataclasses.astuple(self)
        if not all(isinstance(value, float) and np.isfinite(value) for value in values):
            raise InputError(f"calibration is {values}; expected finite numbers")
        if not 0 <= self.unknown_below <= 1:
            raise InputError(f"calibration: unknown_below is {self.unknown_below}; expected a confidence from 0 to 1")

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> "Calibration | None":
        """Return the calibration in the record of a run; None if it has none.

        Raises:
            InputError: it is damaged.
        """
        return stored_value(cls, "calibration", record, "train the run again")

    def score(self, fused: Probabilities, embedding: Probabilities) -> NDArray[np.float64]:
        """Return the score [B] of the most probable class, below 1; the arguments are those of `answer_features`."""
        answer, known = answer_features(fused, embedding).T
        correct = expit(self.correct_bias + self.correct_factor * answer)
        score = correct * expit(self.known_bias + self.known_factor * known)
        return np.asarray(np.minimum(score, 1 - np.finfo(np.float64).epsneg))  # so that its log-odds are finite

    def confidence(self, fused: Probabilities, embedding: Probabilities) -> NDArray[np.float64]:
        """Return the confidence [B] of the most probable class; the arguments are those of `answer_features`."""
        return np.asarray(expit(self.score_bias + self.score_factor * logit(self.score(fused, embedding))))

    def calibrated(self, fused: Probabilities, embedding: Probabilities) -> Probabilities:
        """Return the class probabilities [B, C], scaled so that the largest one is the confidence."""
        largest = np.maximum(fused.max(axis=1, keepdims=True), np.finfo(np.float32).tiny)
        return fused / largest * self.confidence(fused, embedding)[:, None]
