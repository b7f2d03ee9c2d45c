"""Ways to make one answer of several classifiers' probabilities."""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thor2_jax.classifier import FEATURES, Feature, join

__all__ = ["RULES", "Rule", "join_by", "joinings", "main_joining"]

Rule = Literal["larger", "mean", "log-mean"]
RULES: tuple[Rule, ...] = ("larger", "mean", "log-mean")
"""Larger top-1 probability (the paper's); mean of the probabilities; their geometric mean."""


def joinings(available: Iterable[Feature]) -> dict[str, tuple[Feature, ...]]:
    """Every combination of the classifiers at hand, by the paper's names: CE, TOPS, ..., THOR2 (= TOPS + TOPS2)."""
    given = set(available)
    names = [name for name in FEATURES if name in given]
    groups = [group for size in range(1, len(names) + 1) for group in itertools.combinations(names, size)]
    return {"THOR2" if group == ("tops", "tops2") else "+".join(group).upper(): group for group in groups}


def main_joining(names: Iterable[str]) -> str:
    """THOR2 if it is among the names, otherwise the last."""
    names = list(names)
    return "THOR2" if "THOR2" in names else names[-1]


def join_by(
    rule: Rule, probabilities: Mapping[Feature, NDArray[np.floating[Any]]]
) -> tuple[NDArray[np.intp], NDArray[np.floating[Any]]]:
    """Winning class [B] and its probability [B] of the [B, C] probabilities of each classifier."""
    if rule == "larger":
        joined = join(probabilities)
        return joined.class_index, joined.confidence
    stacked = np.stack(list(probabilities.values())).astype(np.float64)  # [M, B, C]
    if rule == "mean":
        together = stacked.mean(axis=0)
    else:
        together = np.exp(np.log(np.maximum(stacked, np.finfo(np.float32).tiny)).mean(axis=0))
        together /= together.sum(axis=1, keepdims=True)
    return together.argmax(axis=1), together.max(axis=1)
