"""Fusion: one answer from the class probabilities of several classifiers (paper, section "Recognition").

Each rule makes one distribution over the classes from those of the classifiers; its most probable class is the answer
and that class's probability is the confidence:

- "max", the paper's rule: the distribution of the classifier with the largest top-1 probability.
- "mean": the arithmetic mean of the distributions.
- "log-mean", the default: their geometric mean (the mean of the log-probabilities), normalized to sum to one. A class
  wins only if every classifier finds it likely.

>>> shape, color = np.array([[0.6, 0.4]], np.float32), np.array([[0.1, 0.9]], np.float32)
>>> fuse({"tops": shape, "tops2": color}, "max").class_index
array([1])
"""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.classifier import Feature

__all__ = ["DEFAULT_RULE", "FUSION_RULES", "Fused", "FusionRule", "fuse"]

FusionRule = Literal["max", "mean", "log-mean"]
FUSION_RULES: tuple[FusionRule, ...] = ("max", "mean", "log-mean")
"""All fusion rules, the paper's first."""

DEFAULT_RULE: FusionRule = "log-mean"
"""The rule with the highest accuracy on held-out synthetic views."""


class Fused(NamedTuple):
    """The fused answer to each of B clouds.

    Attributes:
        class_index: [B] int, the most probable class.
        confidence: [B] float, its fused probability.
        classifier: [B] str, the classifier that gives this class the largest probability.
    """

    class_index: NDArray[np.intp]
    confidence: NDArray[np.floating[Any]]
    classifier: NDArray[np.str_]


def fuse(probabilities: Mapping[Feature, NDArray[np.floating[Any]]], rule: FusionRule = DEFAULT_RULE) -> Fused:
    """Fuse the class probabilities of several classifiers.

    Args:
        probabilities: classifier -> class probabilities [B, C].
        rule: fusion rule, see the module's docstring. With "max", the first classifier wins a tie.
    """
    names = np.array(list(probabilities))
    stacked = np.stack([probabilities[name] for name in probabilities])  # [M, B, C]
    clouds = np.arange(stacked.shape[1])
    if rule == "max":
        fused = stacked[stacked.max(axis=2).argmax(axis=0), clouds]
    elif rule == "mean":
        fused = stacked.astype(np.float64).mean(axis=0)
    else:
        fused = np.exp(np.log(np.maximum(stacked, np.finfo(np.float32).tiny, dtype=np.float64)).mean(axis=0))
        fused /= fused.sum(axis=1, keepdims=True)
    index = fused.argmax(axis=1)
    return Fused(index, fused.max(axis=1), names[stacked[:, clouds, index].argmax(axis=0)])
