"""Accuracy by parts of a dataset, over several runs (paper, section "Results": mean and standard deviation)."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Figure", "over_runs", "parts", "tables_of"]

_ORDER = {"none": 0, "low": 1, "high": 2}

_TABLES: dict[str, tuple[tuple[str, ...], ...]] = {
    "uwis": (
        ("environment",),
        ("environment", "category"),
        ("environment", "occlusion"),
        ("environment", "light"),
    ),
    "ocid": (("camera",), ("camera", "place"), ("camera", "type"), ("camera", "place", "type"), ("sequence",)),
}
"""The paper's tables of its two datasets, each by values of these attributes."""


def tables_of(kind: str, attributes: Sequence[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """By which attributes accuracy is told: none first, then those of the paper's tables, or each by itself."""
    known = sorted({name for each in attributes for name in each})
    tables = _TABLES.get(kind, tuple((name,) for name in known))
    return [(), *(table for table in tables if set(table) <= set(known))]


def parts(attributes: Sequence[Mapping[str, str]], names: Sequence[str]) -> dict[tuple[str, ...], NDArray[np.intp]]:
    """Values of the attributes named -> indices of those that have them; what lacks one of them is in no part."""
    found: dict[tuple[str, ...], list[int]] = {}
    for index, each in enumerate(attributes):
        if all(name in each for name in names):
            found.setdefault(tuple(each[name] for name in names), []).append(index)
    ordered = sorted(found, key=lambda values: [(_ORDER.get(value, -1), value) for value in values])
    return {values: np.array(found[values], np.intp) for values in ordered}


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure of several runs.

    Attributes:
        mean: over the runs; None if none of them has it.
        std: sample standard deviation (n - 1) over the runs; None of a single one.
        runs: how many have it.
    """

    mean: float | None
    std: float | None
    runs: int


def over_runs(values: Sequence[float]) -> Figure:
    """Mean and standard deviation; values that are not finite (of nothing) are left out."""
    finite: NDArray[Any] = np.array([value for value in values if np.isfinite(value)])
    return Figure(
        float(finite.mean()) if len(finite) else None,
        float(finite.std(ddof=1)) if len(finite) > 1 else None,
        len(finite),
    )
