"""Breakdown of a dataset by attributes, and statistics over runs (paper, section "Results")."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["attribute_tables", "group_by_attributes", "summarize_rows", "summarize_runs"]

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
"""Attributes of the paper's tables for its two datasets."""


def attribute_tables(kind: str, attributes: Sequence[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """Return the attributes of each table: none for the first, then the paper's tables or each attribute by itself."""
    known = sorted({name for each in attributes for name in each})
    tables = _TABLES.get(kind, tuple((name,) for name in known))
    return [(), *(table for table in tables if set(table) <= set(known))]


def group_by_attributes(
    attributes: Sequence[Mapping[str, str]], names: Sequence[str]
) -> dict[tuple[str, ...], NDArray[np.intp]]:
    """Return the indices for each combination of the named attributes' values; entries that lack one are left out."""
    groups: dict[tuple[str, ...], list[int]] = {}
    for index, each in enumerate(attributes):
        if all(name in each for name in names):
            groups.setdefault(tuple(each[name] for name in names), []).append(index)
    ordered = sorted(groups, key=lambda values: [(_ORDER.get(value, -1), value) for value in values])
    return {values: np.array(groups[values], np.intp) for values in ordered}


def summarize_runs(values: Sequence[float]) -> dict[str, Any]:
    """Return the statistics of a value over several runs as a JSON table.

    They are the `mean` over the runs that have a finite value, None if none has; the sample standard deviation (n - 1)
    `std`, None for fewer than two; and the number of these `runs`.
    """
    finite: NDArray[Any] = np.array([value for value in values if np.isfinite(value)])
    return {
        "mean": float(finite.mean()) if len(finite) else None,
        "std": float(finite.std(ddof=1)) if len(finite) > 1 else None,
        "runs": len(finite),
    }


def summarize_rows(rows: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return `summarize_runs` of every value of the runs' rows, which have the same names; at least one row."""
    return {name: summarize_runs([row[name] for row in rows]) for name in rows[0]}
