"""Fusion: one answer from the class probabilities of several classifiers (paper, section "Recognition").

Each rule makes one distribution over the classes from those of the classifiers; its most probable class is the answer
and that class's probability is the confidence:

- "max", the paper's rule: the distribution of the classifier with the largest top-1 probability.
- "mean": the arithmetic mean of the distributions.
- "log-mean", the default: their geometric mean (the mean of the log-probabilities), normalized to sum to one. A class
  wins only if every classifier finds it likely.

>>> shape, color = np.array([[0.6, 0.4]], np.float32), np.array([[0.1, 0.9]], np.float32)
>>> fused_probabilities({"tops": shape, "tops2": color}, "max").argmax(axis=1)
array([1])
"""

from collections.abc import Mapping
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

__all__ = ["DEFAULT_RULE", "FUSION_RULES", "FusionRule", "fused_probabilities", "with_temperature"]

FusionRule = Literal["max", "mean", "log-mean"]
FUSION_RULES: tuple[FusionRule, ...] = ("max", "mean", "log-mean")
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
