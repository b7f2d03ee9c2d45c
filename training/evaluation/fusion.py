"""Ways to make one answer of several classifiers' probabilities."""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.classifier import FEATURES, Feature
from thor2_jax.recognition.fusion import FUSION_RULES, FusionRule, fuse
from training.baselines.baseline import TITLES
from training.fitting.temperature import with_temperature

__all__ = ["RULES", "Rule", "join_by", "joinings", "main_joining"]

Rule = FusionRule | Literal["calibrated"]
RULES: tuple[Rule, ...] = (*FUSION_RULES, "calibrated")
"""The rules of `fuse`, the paper's first, and the paper's after temperatures fitted on held-out views."""


def joinings(available: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The baselines at hand, each by itself, and every combination of classifiers.

    These have the paper's names: CE, TOPS, ..., THOR2 (= TOPS + TOPS2).
    """
    given = set(available)
    names = [name for name in FEATURES if name in given]
    groups = [group for size in range(1, len(names) + 1) for group in itertools.combinations(names, size)]
    alone: dict[str, tuple[str, ...]] = {title: (name,) for name, title in TITLES.items() if name in given}
    return alone | {"THOR2" if group == ("tops", "tops2") else "+".join(group).upper(): group for group in groups}


def main_joining(names: Iterable[str]) -> str:
    """THOR2 if it is among the names, otherwise the last."""
    names = list(names)
    return "THOR2" if "THOR2" in names else names[-1]


def join_by(
    rule: Rule, probabilities: Mapping[str, NDArray[np.floating[Any]]], temperatures: Mapping[str, float] | None = None
) -> tuple[NDArray[np.intp], NDArray[np.floating[Any]]]:
    """Winning class [B] and its probability [B].

    Args:
        rule: how to join.
        probabilities: [B, C] of each classifier.
        temperatures: of each, for "calibrated".
    """
    if rule == "calibrated":
        assert temperatures is not None
        probabilities = {name: with_temperature(found, temperatures[name]) for name, found in probabilities.items()}
        rule = "max"
    fused = fuse(cast(Mapping[Feature, NDArray[np.floating[Any]]], probabilities), rule)
    return fused.class_index, fused.confidence
