"""Published accuracies that reports show beside the measured ones; `published.json` gives the sources."""

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

__all__ = [
    "PublishedCell",
    "PublishedDataset",
    "PublishedFigure",
    "PublishedTable",
    "published_attributes",
    "published_dataset",
    "published_means",
    "published_seconds",
    "published_tables",
]

_LIGHTS = {"1": "bright", "2": "dim"}
"""Light of UW-IS Occluded: number in the dataset -> name in the paper. The paper does not say so; see the note in
`published.json`."""


@dataclasses.dataclass(frozen=True)
class PublishedFigure:
    """An accuracy as printed, in percent.

    Attributes:
        mean: mean over the models.
        std: standard deviation over the models; None if it is not known.
    """

    mean: float
    std: float | None


@dataclasses.dataclass(frozen=True)
class PublishedCell:
    """A row of a published table.

    Attributes:
        where: attribute values of its instances, as the paper names them; empty for the whole dataset.
        figures: method -> accuracy.
    """

    where: Mapping[str, str]
    figures: Mapping[str, PublishedFigure]


@dataclasses.dataclass(frozen=True)
class PublishedTable:
    """A published table.

    Attributes:
        source: the publication.
        number: number of the table in the publication; None if it is not known.
        title: title of the table.
        own_objects: whether the classes are the objects of the frame's own sequence (OCID); None if the dataset has no
            such distinction.
        objects: number of objects that are scored; None if it is not known or differs by sequence.
        models: number of models behind each figure; None if it is not known.
        notes: limits of the figures.
        cells: the rows, in the order of the publication.
    """

    source: str
    number: int | None
    title: str
    own_objects: bool | None
    objects: int | None
    models: int | None
    notes: Sequence[str]
    cells: Sequence[PublishedCell]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of all methods, in the order of the columns."""
        return tuple(dict.fromkeys(method for cell in self.cells for method in cell.figures))

    def is_comparable(self, own_objects: bool) -> bool:
        """Return whether the table's classes are those of an evaluation on each sequence's own objects, or on all."""
        return self.own_objects in (None, own_objects)


@dataclasses.dataclass(frozen=True)
class PublishedDataset:
    """The data of the published tables.

    Attributes:
        concerns: the dataset in words.
        frames: number of frames; None if it is not known.
        instances: number of instances; None if it is not known.
    """

    concerns: str
    frames: int | None
    instances: int | None


@functools.cache
def _read() -> dict[str, Any]:
    text = resources.files("training.evaluation").joinpath("published.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


@functools.cache
def published_tables(kind: str) -> tuple[PublishedTable, ...]:
    """Return the published tables of a kind of dataset ("uwis", "ocid"); none for other kinds."""
    content = _read()
    tables = []
    for table in content["tables"]:
        if table["kind"] == kind:
            cells = [
                PublishedCell(
                    cell["where"], {method: PublishedFigure(*figure) for method, figure in cell["accuracy"].items()}
                )
                for cell in table["cells"]
            ]
            values = {name: table[name] for name in ("number", "title", "own_objects", "objects", "models", "notes")}
            tables.append(PublishedTable(source=content["sources"][table["source"]], cells=cells, **values))
    return tuple(tables)


def published_dataset(kind: str) -> PublishedDataset:
    """Return the data of the published tables of a kind of dataset that has some.

    Raises:
        KeyError: the kind has no published tables.
    """
    return PublishedDataset(**_read()["datasets"][kind])


def published_attributes(kind: str, attributes: Mapping[str, str]) -> dict[str, str]:
    """Return the attributes of a frame with the values that the published tables name.

    The light of UW-IS Occluded is "bright" or "dim", and the sequence a/b/c/seq25 of OCID is "S-25".
    """
    values = dict(attributes)
    if kind == "uwis" and "light" in values:
        values["light"] = _LIGHTS.get(values["light"], values["light"])
    if kind == "ocid" and "sequence" in values:
        name = values["sequence"].rpartition("/")[2]
        values["sequence"] = f"S-{name.removeprefix('seq')}"
    return values


def published_means(kind: str, where: Mapping[str, str], own_objects: bool) -> dict[str, float]:
    """Return method -> published mean accuracy, from 0 to 1, of exactly these attribute values; often empty.

    Args:
        kind: kind of dataset.
        where: attribute values, as the reader names them.
        own_objects: whether the classes are the objects of the frame's own sequence.
    """
    values = published_attributes(kind, where)
    return {
        method: figure.mean / 100
        for table in published_tables(kind)
        if table.is_comparable(own_objects)
        for cell in table.cells
        if cell.where == values
        for method, figure in cell.figures.items()
    }


def published_seconds() -> dict[str, float]:
    """Return system -> seconds per frame."""
    return dict(_read()["seconds_a_frame"])
