"""Published accuracies (sources: `published.json`), compared with measured accuracies, and differences of the data."""

import functools
import json
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.model.fusion import DEFAULT_RULE
from training.evaluation.runs import Run, scratch_networks
from training.evaluation.scores import summarize_runs

__all__ = ["compare_with_published", "published_seconds"]

_LIGHTS = {"1": "bright", "2": "dim"}
"""Light of UW-IS Occluded: number in the dataset -> name in the paper, an assumption; see `published.json`."""


@functools.cache
def _read() -> dict[str, Any]:
    return dict(json.loads(resources.files("training.evaluation").joinpath("published.json").read_bytes()))


def published_tables(kind: str) -> list[dict[str, Any]]:
    """Return the published tables for a kind of dataset ("uwis", "ocid") from `published.json`; empty for most kinds.

    The rows are the `cells`, each with attribute values (`where`) and method -> mean and standard deviation in percent
    (`accuracy`). The field `source` contains the citation of the publication.
    """
    content = _read()
    tables = (table for table in content["tables"] if table["kind"] == kind)
    return [{**table, "source": content["sources"][table["source"]]} for table in tables]


def published_attributes(kind: str, attributes: Mapping[str, str]) -> dict[str, str]:
    """Return the attributes of a frame with the values that the published tables use.

    The light of UW-IS Occluded is "bright" or "dim", and the sequence a/b/c/seq25 of OCID is "S-25".
    """
    values = dict(attributes)
    if kind == "uwis" and "light" in values:
        values["light"] = _LIGHTS.get(values["light"], values["light"])
    if kind == "ocid" and "sequence" in values:
        values["sequence"] = "S-" + values["sequence"].rpartition("/")[2].removeprefix("seq")
    return values


def published_seconds() -> dict[str, float]:
    """Return published method -> seconds per frame."""
    return dict(_read()["seconds_a_frame"])


_OURS = {"THOR (MLP)": "THOR"}
"""Published methods whose name differs from the title of the measured column."""

_SYNTHETIC, _REAL, _SMALL = ", synthetic", ", +100 % YCB", "-small"
"""Suffixes of published methods trained without and with all real images, and of the titles of small networks."""


def _measured_column(method: str, real_views: bool, titles: Collection[str]) -> str | None:
    """Return the title of the measured column for a published method, possibly of a small network in its place."""
    other, own = (_SYNTHETIC, _REAL) if real_views else (_REAL, _SYNTHETIC)
    if method.endswith(other):
        return None
    name = method.removesuffix(own)
    return next((title for title in (_OURS.get(name, name), name + _SMALL) if title in titles), None)


def compare_with_published(
    kind: str,
    runs: Sequence[Run],
    n_frames: int,
    attributes: Sequence[Mapping[str, str]],
    objects: Sequence[str],
    correct: Mapping[str, Sequence[NDArray[np.bool_]]],
) -> list[dict[str, Any]]:
    """Return the published tables for which the evaluation has instances, each with the measured accuracies.

    Args:
        kind: kind of dataset ("uwis", "ocid", ...).
        runs: evaluated runs.
        n_frames: number of frames.
        attributes: [N] attributes of the scored instances.
        objects: [N] names of their objects.
        correct: column title -> for each run, whether each instance is recognized correctly, [N].

    Returns:
        JSON tables with "number", "title", "source", "notes", "differences" (sentences), "ours" (published method ->
        title of the measured column, if there is one) and "cells". A cell has "where", "instances", "published"
        (method -> mean and standard deviation, from 0 to 1) and "accuracy" (title -> `summarize_runs`). Rows without an
        instance are left out.
    """
    values = [published_attributes(kind, each) for each in attributes]
    comparisons, real_views = [], any(run.has_real_views for run in runs)
    for table in published_tables(kind):
        if table["own_objects"] not in (None, runs[0].own_objects):
            continue
        cells, shown = [], np.zeros(len(values), bool)
        for cell in table["cells"]:
            rows = np.array([cell["where"].items() <= each.items() for each in values], bool)
            if rows.any():
                shown |= rows
                published = {
                    method: {"mean": mean / 100, "std": None if std is None else std / 100}
                    for method, (mean, std) in cell["accuracy"].items()
                }
                accuracy = {t: summarize_runs([marks[rows].mean() for marks in each]) for t, each in correct.items()}
                measured = {"instances": int(rows.sum()), "published": published, "accuracy": accuracy}
                cells.append({"where": cell["where"], **measured})
        if cells:
            methods = dict.fromkeys(method for cell in table["cells"] for method in cell["accuracy"])
            columns = {method: _measured_column(method, real_views, correct) for method in methods}
            ours = {method: title for method, title in columns.items() if title is not None}
            n_objects = len({name for name, is_shown in zip(objects, shown, strict=True) if is_shown})
            counts = f"frames {n_frames:,}, objects {n_objects}, models {len(runs)}"
            titles = dict.fromkeys(ours.values())
            differences = _differences(table, counts, len(cells), titles, scratch_networks(runs))
            kept = {name: table[name] for name in ("number", "title", "source", "notes")}
            comparisons.append({**kept, "differences": differences, "ours": ours, "cells": cells})
    return comparisons


def _differences(
    table: Mapping[str, Any], counts: str, n_rows: int, titles: Collection[str], scratch: Collection[str]
) -> list[str]:
    """Return sentences on the data of a table and of the evaluation, with its `counts`, and on its image networks."""
    published = " and ".join(f"{table[name] or 'an unstated number of'} {name}" for name in ("objects", "models"))
    return [
        f"The published figures concern {_read()['datasets'][table['kind']]}, with {published}.",
        f"Numbers here: {counts}. The models were trained on other views and folds, and their classifiers are fused by "
        f"the rule {DEFAULT_RULE}; {n_rows} of the table's {len(table['cells'])} rows have instances.",
        *(f"{title} is a smaller network than the published one." for title in titles if title.endswith(_SMALL)),
        *(
            f"{title} was trained from scratch, without pretrained weights: its accuracy does not represent the "
            "published network."
            for title in titles
            if title in scratch
        ),
    ]
