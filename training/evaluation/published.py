"""Figures of publications, to stand beside our own for the same cell of a table; `published.json` tells the sources."""

import dataclasses
import json
from collections.abc import Mapping
from importlib import resources
from typing import Any

__all__ = ["Published", "published", "published_seconds"]


@dataclasses.dataclass(frozen=True)
class Published:
    """What is known for a dataset.

    Attributes:
        source: where the figures were seen.
        concerns: the frames that they are of.
        missing: which figures of the papers were not found.
        methods: names of all methods, in the order of the file.
    """

    source: str
    concerns: str
    missing: str
    methods: tuple[str, ...]
    _cells: Mapping[frozenset[tuple[str, str]], Mapping[str, float]]

    def of(self, where: Mapping[str, str]) -> dict[str, float]:
        """Method -> accuracy from 0 to 1 in the cell with just these values of attributes; often empty."""
        return {method: percent / 100 for method, percent in self._cells.get(frozenset(where.items()), {}).items()}


def _file() -> dict[str, Any]:
    text = resources.files("training.evaluation").joinpath("published.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def published(kind: str) -> Published | None:
    """The accuracies for a kind of dataset ("uwis", "ocid"); None if there are none."""
    table = _file()["accuracy"].get(kind)
    if table is None:
        return None
    cells = {frozenset(cell["where"].items()): cell["accuracy"] for cell in table["cells"]}
    methods = tuple(dict.fromkeys(method for accuracy in cells.values() for method in accuracy))
    return Published(table["source"], table["concerns"], table["missing"], methods, cells)


def published_seconds() -> dict[str, float]:
    """System -> seconds a frame."""
    return dict(_file()["seconds_a_frame"])
