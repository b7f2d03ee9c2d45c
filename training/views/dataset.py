"""Datasets of normalized views on disk: what `render_dataset` writes and training reads.

    dataset = ViewDataset.open("views")
    dataset.classes, len(dataset)
    for index in range(len(dataset.shards)):
        views = dataset.read(index)                # views.xyz, views.rgb, views.counts, views.label

A folder holds `manifest.json` and shards, each with views of one object. A shard is a safetensors file:

    xyz     [n, 3] uint16   points of all views, one view after the other, in `COORDINATE_STEP` scaled units
    rgb     [n, 3] uint8    sRGB
    counts  [V] int64       points of each view
    view    [V] int32       index of the view's angles among those of its object
    copy    [V] int32       0 is the view as rendered, others are varied

The manifest holds the job, which is all that the views depend on, and the shards that are done, with their checksums.
There are no times in it: the same job gives the same bytes.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from training.views.normalized_views import COORDINATE_STEP, NormalizedViews

__all__ = ["MANIFEST", "Manifest", "NormalizedViews", "Shard", "ViewDataset", "encode"]

MANIFEST_FORMAT = 2
MANIFEST = "manifest.json"


def encode(views: NormalizedViews) -> bytes:
    """The file of a shard with these views."""
    steps = (views.xyz / np.float32(COORDINATE_STEP)).astype(np.uint16)
    return safetensors.numpy.save(
        {"xyz": steps, "rgb": views.rgb, "counts": views.counts, "view": views.view, "copy": views.copy}
    )


def _decode(content: bytes, label: int) -> NormalizedViews:
    arrays = safetensors.numpy.load(content)
    xyz = arrays["xyz"].astype(np.float32) * np.float32(COORDINATE_STEP)
    return NormalizedViews(xyz, arrays["rgb"], arrays["counts"], label, arrays["view"], arrays["copy"])


@dataclasses.dataclass(frozen=True)
class Shard:
    """A file of a dataset.

    Attributes:
        file: name in the dataset's folder.
        sha256: of its bytes.
        label: index of its object among the dataset's classes.
        views: number stored.
        left_out: number of views that would be in it, had they shown enough points of the object.
        points: of all its views.
    """

    file: str
    sha256: str
    label: int
    views: int
    left_out: int
    points: int

    def __post_init__(self) -> None:
        numbers = (self.label, self.views, self.left_out, self.points)
        if not all(type(number) is int and number >= 0 for number in numbers):
            raise ValueError(f"label, views, left_out, points are {numbers!r}; expected whole numbers")
        if not isinstance(self.file, str) or Path(self.file).name != self.file:
            raise ValueError(f"file is {self.file!r}; expected a name in the folder")

    def content(self, folder: Path) -> bytes:
        """The bytes of the file.

        Raises:
            InputError: it is missing, cannot be read, or has another checksum; names the file.
        """
        path = folder / self.file
        try:
            content = path.read_bytes()
        except OSError as error:
            raise InputError(f"dataset: {path} is missing or damaged ({error.strerror})") from None
        if hashlib.sha256(content).hexdigest() != self.sha256:
            raise InputError(f"dataset: {path} is damaged (its checksum is not the one in {MANIFEST})")
        return content


def _dump(table: Mapping[str, Any]) -> str:
    return json.dumps(table, indent=1) + "\n"


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a dataset's folder says of itself.

    Attributes:
        job: all that the views depend on, as JSON holds it. `objects` is a list of tables with `name` and `mesh` (the
            mesh's checksum), `shards` the number of shards.
        shards: those that are done, in the order of the job.
    """

    job: Mapping[str, Any]
    shards: tuple[Shard, ...] = ()

    @property
    def finished(self) -> bool:
        """All shards are done."""
        return len(self.shards) == self.job["shards"]

    @property
    def views(self) -> int:
        """Views in all shards."""
        return sum(shard.views for shard in self.shards)

    @property
    def left_out(self) -> int:
        """Views left out of all shards."""
        return sum(shard.left_out for shard in self.shards)

    def write(self, folder: Path) -> None:
        """Put this manifest in the place of the folder's.

        Raises:
            OSError: the folder cannot be written.
        """
        table = {
            "format": MANIFEST_FORMAT,
            "views": self.views,
            "left_out": self.left_out,
            "job": self.job,
            "shards": [dataclasses.asdict(shard) for shard in self.shards],
        }
        checksum = hashlib.sha256(_dump(table).encode()).hexdigest()
        write_text(folder / MANIFEST, _dump({**table, "sha256": checksum}))

    @classmethod
    def parse(cls, content: bytes, path: Path) -> "Manifest":
        """The manifest in the bytes of a file.

        Raises:
            InputError: it is damaged or has another format; names `path`.
        """
        try:
            table = json.loads(content)
            if table["format"] == MANIFEST_FORMAT:
                checksum = table.pop("sha256")
                if checksum != hashlib.sha256(_dump(table).encode()).hexdigest():
                    raise ValueError("its checksum is not its own")
                found = cls(table["job"], tuple(Shard(**shard) for shard in table["shards"]))
                names = [entry["name"] for entry in found.job["objects"]]
                if not all(isinstance(name, str) for name in names):
                    raise ValueError(f"its objects are named {names!r}")
                if any(shard.label >= len(names) for shard in found.shards):
                    raise ValueError(f"it has shards of other objects than its {len(names)}")
                if type(found.job["shards"]) is not int or "descriptor_version" not in found.job:
                    raise ValueError("its job lacks the number of shards or the descriptor's version")
                return found
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"dataset: {path} is damaged ({type(error).__name__}: {error})") from None
        raise InputError(f"dataset: {path} has format {table['format']!r}; this version reads {MANIFEST_FORMAT}")


@dataclasses.dataclass(frozen=True)
class ViewDataset:
    """A finished dataset; `len` is the number of its views.

    Attributes:
        folder: that holds it.
        manifest: its contents.
        digest: SHA-256 of the manifest's file, which holds the checksums of all the others.
    """

    folder: Path
    manifest: Manifest
    digest: str

    @classmethod
    def open(cls, path: str | Path) -> "ViewDataset":
        """Read the manifest of a folder that `render_dataset` wrote. Shards are read, and checked, by `read`.

        Raises:
            InputError: no such folder; no manifest in it, a damaged one, or one of another format or version of the
                descriptor; or rendering did not finish. Names the file.
        """
        folder = Path(path)
        if not folder.is_dir():
            raise InputError(f"dataset: {folder} is no folder")
        try:
            content = (folder / MANIFEST).read_bytes()
        except OSError as error:
            raise InputError(f"dataset: {folder / MANIFEST} cannot be read ({error.strerror})") from None
        manifest = Manifest.parse(content, folder / MANIFEST)
        version = manifest.job["descriptor_version"]
        if version != DESCRIPTOR_VERSION:
            raise InputError(
                f"dataset: {folder / MANIFEST} has views for version {version} of the descriptor; this is version "
                f"{DESCRIPTOR_VERSION}"
            )
        if not manifest.finished:
            raise InputError(
                f"dataset: {folder / MANIFEST} lists {len(manifest.shards)} of {manifest.job['shards']} shards; "
                "rendering did not finish and goes on with the same command"
            )
        return cls(folder, manifest, hashlib.sha256(content).hexdigest())

    def __len__(self) -> int:
        return self.manifest.views

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the objects; labels are indices into it."""
        return tuple(entry["name"] for entry in self.manifest.job["objects"])

    @property
    def shards(self) -> tuple[Shard, ...]:
        """The files, in the order of the classes and of their views' angles."""
        return self.manifest.shards

    @property
    def record(self) -> Mapping[str, Any]:
        """What a run trained on these views keeps of them, as JSON holds it."""
        return {
            "digest": self.digest,
            "views": self.manifest.views,
            "left_out": self.manifest.left_out,
            "job": self.manifest.job,
        }

    def read(self, index: int) -> NormalizedViews:
        """The views of a shard.

        Raises:
            InputError: its file is missing or damaged; names it.
        """
        shard = self.shards[index]
        return _decode(shard.content(self.folder), shard.label)
