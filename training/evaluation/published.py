"""Published values that reports show beside the measured ones; `published.json` gives the sources."""

import dataclasses
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

__all__ = ["Published", "published", "published_seconds"]


@dataclasses.dataclass(frozen=True)
class Published:
    """Published accuracies on a dataset.

    Attributes:
        source: where the values were found.
        concerns: the frames that they refer to.
        missing: values of the papers that were not found.
        methods: names of all methods, in the order of the file.
    """

    source: str
    concerns: str
    missing: str
    methods: tuple[str, ...]
    _cells: Mapping[frozenset[tuple[str, str]], Mapping[str, float]]

    def cell(self, where: Mapping[str, str]) -> dict[str, float]:
        """Return method -> accuracy, from 0 to 1, for exactly these attribute values; often empty."""
        return {method: percent / 100 for method, percent in self._cells.get(frozenset(where.items()), {}).items()}


def _read() -> dict[str, Any]:
    text = resources.files("training.evaluation").joinpath("published.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def published(kind: str) -> Published | None:
    """Return the published accuracies for a kind of dataset ("uwis", "ocid"); None if there are none."""
    table = _read()["accuracy"].get(kind)
    if table is None:
        return None
    cells = {frozenset(cell["where"].items()): cell["accuracy"] for cell in table["cells"]}
    methods = tuple(dict.fromkeys(method for accuracy in cells.values() for method in accuracy))
    return Published(table["source"], table["concerns"], table["missing"], methods, cells)


def published_seconds() -> dict[str, float]:
    """Return system -> seconds per frame."""
    return dict(_read()["seconds_a_frame"])
