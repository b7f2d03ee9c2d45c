"""Fusion of several classifiers: combinations, their names in tables, and the rules."""

import itertools
from collections.abc import Iterable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from thor2_jax.model.classifier import FEATURES
from thor2_jax.model.fusion import FUSION_RULES, FusionRule, fuse, with_temperature
from training.baselines.names import TITLES

__all__ = [
    "ALL_CLASSIFIERS",
    "BOTH",
    "EMBEDDED",
    "GALLERY",
    "WHOLE",
    "RULES",
    "Rule",
    "fuse_by",
    "fusions",
    "main_fusion",
]

Rule = FusionRule | Literal["calibrated"]
RULES: tuple[Rule, ...] = (*FUSION_RULES, "calibrated")
"""The rules of `fuse`, and "calibrated": the rule "max" on temperature-scaled probabilities."""

EMBEDDED, ALL_CLASSIFIERS, GALLERY, BOTH = "embedding", "THOR2+embedding", "gallery", "both"
"""Columns of the embedding alone, of THOR2 with the confidence that the embedding gives (in runs with the paper's
classifiers), of the gallery alone, and of all combined. The recognizer computes them; no rule fuses them."""

WHOLE = (EMBEDDED, ALL_CLASSIFIERS, GALLERY, BOTH)
"""All columns that no rule fuses."""


def fusions(available: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return title -> names for each available baseline and gallery alone and for every combination of classifiers.

    Titles are those of the paper: CE, TOPS, ..., THOR2 (TOPS and TOPS2).
    """
    names = set(available)
    features = [name for name in FEATURES if name in names]
    groups = [group for size in range(1, len(features) + 1) for group in itertools.combinations(features, size)]
    baselines: dict[str, tuple[str, ...]] = {title: (name,) for name, title in TITLES.items() if name in names}
    classifiers = {"THOR2" if group == ("tops", "tops2") else "+".join(group).upper(): group for group in groups}
    return baselines | classifiers | {name: (name,) for name in WHOLE if name in names}


def main_fusion(titles: Iterable[str], answer_by: str = "classifiers") -> str:
    """Return the column that the recognizer answers by.

    Args:
        titles: the columns, at least one.
        answer_by: "classifiers" (the embedding with THOR2, THOR2, the embedding, or the last title: the first of them
            that is among the titles), "gallery" or "both".
    """
    titles = list(titles)
    for title in (answer_by, ALL_CLASSIFIERS, "THOR2", EMBEDDED):
        if title in titles:
            return title
    return [title for title in titles if title not in WHOLE][-1]


def fuse_by(
    rule: Rule, probabilities: Mapping[str, NDArray[np.floating[Any]]], temperatures: Mapping[str, float] | None = None
) -> tuple[NDArray[np.intp], NDArray[np.floating[Any]]]:
    """Return the predicted class [B] and its fused probability [B].

    Args:
        rule: rule of the fusion.
        probabilities: [B, C] class probabilities of each classifier.
        temperatures: temperature of each classifier; needed for "calibrated".
    """
    if set(probabilities) <= set(WHOLE):
        (values,) = probabilities.values()  # scores, which need not sum to 1
        return values.argmax(axis=1), values.max(axis=1)
    if rule == "calibrated":
        assert temperatures is not None
        probabilities = {name: with_temperature(values, temperatures[name]) for name, values in probabilities.items()}
        rule = "max"
    fused = fuse(probabilities, rule)
    return fused.class_index, fused.confidence
