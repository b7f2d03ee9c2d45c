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

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

__all__ = ["DEFAULT_RULE", "FUSION_RULES", "Fused", "FusionRule", "fuse", "fused_probabilities", "with_temperature"]

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


def with_temperature(probabilities: NDArray[np.floating[Any]], temperature: float) -> NDArray[np.float64]:
    """Return softmax(log(probabilities) / temperature), [N, C].

    A temperature above 1 lowers the confidence, one below 1 raises it; the most probable class does not change.
    Logarithms of probabilities are logits up to a constant, which the softmax removes.
    """
    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), np.finfo(np.float32).tiny))
    return np.asarray(softmax(logits / temperature, axis=1))


def fused_probabilities(probabilities: Mapping[str, Any], rule: FusionRule = DEFAULT_RULE) -> Any:
    """Return the fused class probabilities [B, C].

    JAX arrays give a JAX array of their type, with gradients; NumPy arrays give a NumPy array, and their means are
    computed in float64. The arguments are otherwise those of `fuse`.
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


def fuse(probabilities: Mapping[str, NDArray[np.floating[Any]]], rule: FusionRule = DEFAULT_RULE) -> Fused:
    """Fuse the class probabilities of several classifiers.

    Args:
        probabilities: classifier -> class probabilities [B, C].
        rule: fusion rule, see the module's docstring. With "max", the first classifier wins a tie.
    """
    names = np.array(list(probabilities))
    stacked = np.stack([probabilities[name] for name in probabilities])  # [M, B, C]
    fused = fused_probabilities(probabilities, rule)
    index = fused.argmax(axis=1)
    return Fused(index, fused.max(axis=1), names[stacked[:, np.arange(len(index)), index].argmax(axis=0)])
