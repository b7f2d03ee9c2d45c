"""Measured accuracies beside the published tables, and the differences between the data of both."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from training.evaluation.accuracy import summarize_runs
from training.evaluation.fusion import Rule
from training.evaluation.published import (
    PublishedFigure,
    PublishedTable,
    published_attributes,
    published_dataset,
    published_tables,
)

__all__ = ["EvaluationConditions", "compare_with_published"]

_OURS = {"THOR (MLP)": "THOR"}
"""Published methods whose name differs from the title of the measured column."""

_SYNTHETIC, _REAL, _SMALL = ", synthetic", ", +100 % YCB", "-small"
"""What the published tables append to the methods that were trained without and with all real images, and what the
titles of the small networks end with."""

_PAPER_RULE: Rule = "max"
"""Fusion rule of the THOR2 paper."""


@dataclasses.dataclass(frozen=True)
class EvaluationConditions:
    """Facts that an evaluation states beside published figures.

    Attributes:
        own_objects: whether the classes are the objects of the frame's own sequence.
        models: number of trained models.
        frames: number of frames.
        rule: fusion rule of the measured accuracies.
        real_views: whether the models were trained on real views, too.
        scratch: titles of the baselines whose networks were trained without pretrained weights.
    """

    own_objects: bool
    models: int
    frames: int
    rule: Rule
    real_views: bool = False
    scratch: Collection[str] = ()


def _measured_column(method: str, conditions: EvaluationConditions, titles: Collection[str]) -> str | None:
    """Return the title of the measured column of a published method, that of a small network if it stands for it."""
    other, own = (_SYNTHETIC, _REAL) if conditions.real_views else (_REAL, _SYNTHETIC)
    if method.endswith(other):
        return None
    name = method.removesuffix(own)
    return next((title for title in (_OURS.get(name, name), name + _SMALL) if title in titles), None)


def compare_with_published(
    kind: str,
    conditions: EvaluationConditions,
    attributes: Sequence[Mapping[str, str]],
    objects: Sequence[str],
    correct: Mapping[str, Sequence[NDArray[np.bool_]]],
) -> list[dict[str, Any]]:
    """Return the published tables that the evaluation has instances for, each with the measured accuracies.

    Args:
        kind: kind of dataset ("uwis", "ocid", ...).
        conditions: conditions of the evaluation.
        attributes: [N] attributes of the scored instances.
        objects: [N] names of their objects.
        correct: column title -> for each run, [N] whether the instance is recognized correctly.

    Returns:
        JSON tables with "number", "title", "source", "notes", "differences" (sentences), "ours" (published method ->
        title of the measured column, where there is one) and "cells". A cell has "where", "instances", "published"
        (method -> mean and standard deviation, from 0 to 1) and "accuracy" (title -> `RunStatistics`). Rows without an
        instance are left out.
    """
    values = [published_attributes(kind, each) for each in attributes]
    comparisons = []
    for table in published_tables(kind):
        if not table.is_comparable(conditions.own_objects):
            continue
        cells, shown = [], np.zeros(len(values), bool)
        for cell in table.cells:
            rows = np.array([cell.where.items() <= each.items() for each in values], bool)
            if rows.any():
                shown |= rows
                published = {method: _fractions(figure) for method, figure in cell.figures.items()}
                accuracy = {t: summarize_runs([marks[rows].mean() for marks in each]) for t, each in correct.items()}
                counts = {"instances": int(rows.sum())}
                cells.append({"where": dict(cell.where), **counts, "published": published, "accuracy": accuracy})
        if cells:
            columns = {method: _measured_column(method, conditions, correct) for method in table.methods}
            ours = {method: title for method, title in columns.items() if title is not None}
            n_objects = len({name for name, is_shown in zip(objects, shown, strict=True) if is_shown})
            comparisons.append(
                {
                    "number": table.number,
                    "title": table.title,
                    "source": table.source,
                    "notes": list(table.notes),
                    "differences": [
                        *_differences(kind, table, conditions, n_objects, len(cells)),
                        *_network_differences(ours.values(), conditions),
                    ],
                    "ours": ours,
                    "cells": cells,
                }
            )
    return comparisons


def _fractions(figure: PublishedFigure) -> dict[str, float | None]:
    return {"mean": figure.mean / 100, "std": None if figure.std is None else figure.std / 100}


def _network_differences(titles: Iterable[str], conditions: EvaluationConditions) -> list[str]:
    """Return the limits of the measured image networks."""
    sentences = []
    for title in dict.fromkeys(titles):
        if title.endswith(_SMALL):
            sentences.append(f"{title} is a smaller network than the published one.")
        if title in conditions.scratch:
            sentences.append(
                f"{title} was trained from scratch, without pretrained weights: its accuracy is no claim about the "
                "published network."
            )
    return sentences


def _differences(
    kind: str, table: PublishedTable, conditions: EvaluationConditions, n_objects: int, n_rows: int
) -> list[str]:
    """Return one sentence for each known difference between the data of the table and of the evaluation."""
    data = published_dataset(kind)
    size = f" ({data.frames:,} frames, {data.instances:,} instances)" if data.frames and data.instances else ""
    sentences = [
        f"The published figures concern {data.concerns}{size}; here {conditions.frames:,} frames are evaluated."
    ]
    if table.objects is None:
        sentences.append(f"Number of objects that are scored here: {n_objects}.")
    elif table.objects != n_objects:
        sentences.append(f"The publication scores {table.objects} objects, this evaluation {n_objects}.")
    if n_rows < len(table.cells):
        sentences.append(f"{len(table.cells) - n_rows} of the table's {len(table.cells)} rows have no instance here.")
    models = "models of its own" if table.models is None else f"{table.models} models"
    sentences.append(
        f"The publication uses {models}; here {conditions.models} "
        f"{'model is' if conditions.models == 1 else 'models are'} evaluated, trained on other views and folds."
    )
    fuses = any("THOR2" in method for method in table.methods)
    if fuses and conditions.rule != _PAPER_RULE:
        sentences.append(
            f"The publication fuses classifiers by the rule {_PAPER_RULE}, this table by {conditions.rule}."
        )
    return sentences
