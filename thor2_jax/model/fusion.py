"""Fusion: one answer from the class probabilities of several classifiers (paper, section "Recognition"); confidence.

Each rule fuses the distributions of the classifiers over the classes into one. Its most probable class is the answer,
and the probability of this class is the confidence:

- "max", the paper's rule: the distribution of the classifier with the largest top-1 probability.
- "mean": the arithmetic mean of the distributions.
- "log-mean", the default: their geometric mean (the mean of the log-probabilities), normalized to sum to one. A class
  wins only if no classifier gives it a low probability.

>>> shape, color = np.array([[0.6, 0.4]], np.float32), np.array([[0.1, 0.9]], np.float32)
>>> fused_probabilities({"tops": shape, "tops2": color}, "max").argmax(axis=1)
array([1])

Confidence is the estimated probability that the answer to a known object is correct; it is low for unknown objects.
The fused probabilities show which of the trained classes is most likely, but not whether the object belongs to any of
them. The embedding of a run is also fitted on distractors, objects that belong to none of the classes. The score of
an answer is the product of two logistic functions,

    score = P(correct | known, fused probability) P(known | the embedding's probability of all classes)

In new runs the first function is constant, since an object that looks like two classes need not be unknown. Known and
unknown objects have equal weights in the fit, so that the score separates them well. The confidence is a third logistic
function, of the log-odds of the score: the fraction of correct answers to known objects with this score (Platt, 1999).
`training` fits the three functions on views that no network was trained on.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, softmax

from thor2_jax.errors import InputError

__all__ = [
    "DEFAULT_RULE",
    "FUSION_RULES",
    "MAX_ODDS",
    "Calibration",
    "FusionRule",
    "answer_features",
    "fused_probabilities",
    "with_temperature",
]

FusionRule = Literal["max", "mean", "log-mean"]
FUSION_RULES: tuple[FusionRule, ...] = get_args(FusionRule)
"""All fusion rules, the paper's first."""

DEFAULT_RULE: FusionRule = "log-mean"
"""The rule with the highest accuracy on held-out synthetic views."""


def with_temperature(probabilities: NDArray[np.floating[Any]], temperature: float) -> NDArray[np.float64]:
    """Return softmax(log(probabilities) / temperature), [N, C].

    A temperature above 1 lowers the confidence, one below 1 raises it; the most probable class does not change.
    Logarithms of probabilities are logits up to a constant, which the softmax removes.
    """
    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), np.finfo(np.float32).tiny))
    return np.asarray(softmax(logits / temperature, axis=1))


def fused_probabilities(probabilities: Mapping[str, Any], rule: FusionRule = DEFAULT_RULE) -> Any:
    """Return the fused class probabilities [B, C] of several classifiers.

    JAX arrays give a JAX array of their type, with gradients; NumPy arrays give a NumPy array, and their means are
    computed in float64.

    Args:
        probabilities: classifier -> class probabilities [B, C].
        rule: fusion rule, see the module's docstring. With "max", the first classifier wins a tie.
    """
    rows = list(probabilities.values())
    on_host = not any(isinstance(row, jax.Array) for row in rows)
    xp: Any = np if on_host else jnp
    stacked = xp.stack(rows)  # [M, B, C]
    if rule == "max":
        return stacked[stacked.max(axis=2).argmax(axis=0), np.arange(stacked.shape[1])]
    if on_host:
        stacked = stacked.astype(np.float64)
    if rule == "mean":
        return stacked.mean(axis=0)
    fused = xp.exp(xp.log(xp.maximum(stacked, np.finfo(np.float32).tiny)).mean(axis=0))
    return fused / fused.sum(axis=1, keepdims=True)


Probabilities = NDArray[np.floating[Any]]

MAX_ODDS = 8.0
"""Largest absolute log-odds of a feature; more extreme probabilities of networks carry no information."""


def answer_features(fused: Probabilities, embedding: Probabilities) -> NDArray[np.float64]:
    """Return the features [B, 2] of a calibration: log-odds of the answer, and of being any class by the embedding.

    Args:
        fused: [B, C] fused class probabilities.
        embedding: [B, C] class probabilities of the embedding; the rest to 1 is the probability of the distractors.
    """
    values = [fused.max(axis=1), embedding.sum(axis=1)]
    return logit(np.stack(values, axis=1).astype(np.float64).clip(0, 1)).clip(-MAX_ODDS, MAX_ODDS)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A fitted calibration of the confidence.

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
