"""Datasets of normalized views on disk, written by `render_dataset` and read by training.

    dataset = ViewDataset.open("views")
    dataset.classes, len(dataset)
    for index in range(len(dataset.shards)):
        views = dataset.read(index)                # views.xyz, views.rgb, views.counts, views.label

A dataset contains normalized point clouds, not images: for each object, one cloud per camera angle as rendered (`copy`
0) and, if the job has augmentations, further clouds of augmented copies of the same view (`copy` 1, 2, ...). Views with
too few points are left out. Its directory has `manifest.json` and shards, safetensors files with views of one object:

    xyz     [n, 3] uint16   points of all views, one view after the other, in `COORDINATE_STEP` scaled units
    rgb     [n, 3] uint8    sRGB
    counts  [V] int64       number of points of each view
    view    [V] int32       index of the view among all views of the object
    copy    [V] int32       0 is the view as rendered, others are augmented copies

The manifest has the job, everything that determines the views, and the finished shards with their checksums. It has no
time stamps: the same job gives the same bytes.

Image networks are trained on crops of the same views, which `render_crops` adds:

    crops = dataset.read_crops(index, 96)          # one crop for each cloud of `read(index)`

    DATASET/crops/manifest.json     size of the crops, digest of the dataset, checksums of the files
    DATASET/crops/*.npz             one file for each shard, with compressed `color` and `normals`
"""

import contextlib
import dataclasses
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.errors import InputError
from thor2_jax.files import content_digest, read_file, remove_written, write_text
from training.views.crops import ViewCrops
from training.views.normalized_views import COORDINATE_STEP, NormalizedViews

__all__ = [
    "CROPS",
    "MANIFEST",
    "Manifest",
    "NormalizedViews",
    "Shard",
    "ViewDataset",
    "crop_file",
    "encode",
    "encode_crops",
    "intact_content",
    "read_crop_manifest",
    "remove_views",
    "write_crop_manifest",
]

MANIFEST = "manifest.json"
MANIFEST_FORMAT = 2

CROPS = "crops"
"""Directory of the crops in the directory of a dataset."""

CROPS_FORMAT = 1


def remove_views(directory: Path) -> None:
    """Remove a dataset of views and their crops; files that `thor2 render` has not written stay."""
    with contextlib.suppress(OSError, InputError):
        Manifest.parse(read_file(directory / MANIFEST), directory / MANIFEST)
        names = r"(manifest\.json|\.lock|[0-9]{4,}-[0-9]{4,}\.(safetensors|npz))"
        remove_written(directory, rf"({CROPS}/)?{names}")


def encode(views: NormalizedViews) -> bytes:
    """Return the bytes of a shard's file."""
    steps = (views.xyz / np.float32(COORDINATE_STEP)).astype(np.uint16)
    others = {name: getattr(views, name) for name in ("rgb", "counts", "view", "copy")}
    return safetensors.numpy.save({"xyz": steps, **others})


def intact_content(directory: Path, name: str, sha256: str) -> bytes | None:
    """Return the bytes of a file; None if it is missing or has another checksum."""
    path = directory / name
    content = path.read_bytes() if path.is_file() else b""
    return content if content_digest([content]) == sha256 else None


@dataclasses.dataclass(frozen=True)
class Shard:
    """A shard of a dataset.

    Attributes:
        file: file name in the dataset's directory.
        sha256: checksum of the file.
        label: index of its object among the dataset's classes.
        views: number of clouds stored.
        left_out: number of clouds left out because they have too few points.
        points: number of points of all clouds.
    """

    file: str
    sha256: str
    label: int
    views: int
    left_out: int
    points: int


def _dump(table: Mapping[str, Any]) -> str:
    return json.dumps(table, indent=1) + "\n"


@dataclasses.dataclass(frozen=True)
class Manifest:
    """The contents of a dataset.

    Attributes:
        job: everything that determines the views, as JSON holds it. `objects` is a list of tables with `name` and
            `mesh` (the mesh's checksum), `shards` the number of shards.
        shards: finished shards, in the order of the job.
    """

    job: Mapping[str, Any]
    shards: tuple[Shard, ...] = ()

    @property
    def views(self) -> int:
        """Number of clouds in all shards."""
        return sum(shard.views for shard in self.shards)

    @property
    def left_out(self) -> int:
        """Number of clouds left out of all shards."""
        return sum(shard.left_out for shard in self.shards)

    def write(self, directory: Path) -> None:
        """Write the manifest to the dataset's directory, replacing the one there.

        Raises:
            OSError: The directory cannot be written.
        """
        table = {
            "format": MANIFEST_FORMAT,
            "views": self.views,
            "left_out": self.left_out,
            "job": self.job,
            "shards": [dataclasses.asdict(shard) for shard in self.shards],
        }
        checksum = content_digest([_dump(table)])
        write_text(directory / MANIFEST, _dump({**table, "sha256": checksum}))

    @classmethod
    def parse(cls, content: bytes, path: Path) -> "Manifest":
        """Return the manifest in the bytes of a file.

        Raises:
            InputError: The manifest is damaged or has another format; the message names `path`.
        """
        try:
            table = json.loads(content)
            if table["format"] == MANIFEST_FORMAT:
                checksum = table.pop("sha256")
                if checksum != content_digest([_dump(table)]):
                    raise ValueError("its checksum differs")
                return cls(table["job"], tuple(Shard(**shard) for shard in table["shards"]))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"dataset: {path} is damaged ({type(error).__name__}: {error})") from None
        raise InputError(f"dataset: {path} has format {table['format']!r}; expected {MANIFEST_FORMAT}; render it again")


def encode_crops(crops: ViewCrops) -> bytes:
    """Return the bytes of a file of crops."""
    stream = io.BytesIO()
    np.savez_compressed(stream, color=crops.color, normals=crops.normals)
    return stream.getvalue()


def write_crop_manifest(directory: Path, size: int, dataset: str, files: Mapping[str, str]) -> None:
    """Write the manifest of a directory of crops.

    Args:
        directory: the directory.
        size: side of the crops, pixels.
        dataset: digest of the dataset.
        files: file name -> SHA-256 of the finished files.

    Raises:
        OSError: the manifest cannot be written.
    """
    content = {"format": CROPS_FORMAT, "size": size, "dataset": dataset, "files": files}
    write_text(directory / MANIFEST, json.dumps(content) + "\n")


def read_crop_manifest(directory: Path) -> tuple[int, str, dict[str, str]]:
    """Return size, dataset and files of the manifest in a directory of crops, see `write_crop_manifest`.

    Raises:
        InputError: it is missing, damaged or of another format.
    """
    path = directory / MANIFEST
    try:
        content = json.loads(path.read_bytes())
        if content["format"] != CROPS_FORMAT:
            raise ValueError(f"its format is {content['format']!r}; expected {CROPS_FORMAT}")
        return int(content["size"]), str(content["dataset"]), dict(content["files"])
    except OSError:
        raise InputError(
            f"dataset: {directory.parent} has no crops, which the networks are trained on; render them: repeat its "
            "`thor2 render` command with --crops"
        ) from None
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"dataset: {path} is damaged ({error}); delete {directory} and render the crops again"
        ) from None


def crop_file(shard: str) -> str:
    """Return the file name of the crops of a shard, given its file name."""
    return Path(shard).with_suffix(".npz").name


@dataclasses.dataclass(frozen=True)
class ViewDataset:
    """A finished dataset; `len` is its number of clouds.

    Attributes:
        directory: path of the dataset.
        manifest: contents of the dataset.
        digest: SHA-256 of the manifest, which has the checksums of all shards.
    """

    directory: Path
    manifest: Manifest
    digest: str

    @classmethod
    def open(cls, path: str | Path) -> "ViewDataset":
        """Open a dataset that `render_dataset` wrote; shards are read and checked by `read`.

        Raises:
            InputError: The directory or its manifest is missing, the manifest is damaged or of another format or
                descriptor version, or the rendering is not finished.
        """
        directory = Path(path)
        if not directory.is_dir():
            raise InputError(f"dataset: {directory} is not a directory; expected the output of `thor2 render`")
        try:
            content = read_file(directory / MANIFEST)
        except OSError as error:
            raise InputError(
                f"dataset: {directory / MANIFEST} cannot be read ({error.strerror}); expected output of `thor2 render`"
            ) from None
        manifest = Manifest.parse(content, directory / MANIFEST)
        version = manifest.job["descriptor_version"]
        if version != DESCRIPTOR_VERSION:
            raise InputError(
                f"dataset: {directory / MANIFEST} has views for descriptor version {version}; expected version "
                f"{DESCRIPTOR_VERSION}; render the views again"
            )
        if len(manifest.shards) != manifest.job["shards"]:
            raise InputError(
                f"dataset: {directory / MANIFEST} lists {len(manifest.shards)} of {manifest.job['shards']} shards; "
                "repeat the `thor2 render` command to finish it"
            )
        return cls(directory, manifest, content_digest([content]))

    def __len__(self) -> int:
        return self.manifest.views

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the objects; labels are indices into this tuple."""
        return tuple(entry["name"] for entry in self.manifest.job["objects"])

    @property
    def shards(self) -> tuple[Shard, ...]:
        """The shards, ordered by class and view."""
        return self.manifest.shards

    @property
    def record(self) -> Mapping[str, Any]:
        """Description of the dataset for the record of a run, as JSON holds it."""
        return {
            "digest": self.digest,
            "views": self.manifest.views,
            "left_out": self.manifest.left_out,
            "job": self.manifest.job,
        }

    def read(self, index: int) -> NormalizedViews:
        """Read the views of a shard.

        Raises:
            InputError: The shard's file is missing or damaged.
        """
        shard = self.shards[index]
        content = intact_content(self.directory, shard.file, shard.sha256)
        if content is None:
            path = self.directory / shard.file
            raise InputError(f"dataset: {path} is missing or damaged; repeat `thor2 render` to restore it")
        arrays = safetensors.numpy.load(content)
        xyz = arrays.pop("xyz").astype(np.float32) * np.float32(COORDINATE_STEP)
        return NormalizedViews(xyz, label=shard.label, **arrays)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of a shard's views, in their order.

        Args:
            index: index of the shard.
            size: side of the crops, pixels; larger stored ones are reduced.

        Raises:
            InputError: The dataset has no crops or smaller ones, or a file is missing or damaged.
        """
        directory, name = self.directory / CROPS, crop_file(self.shards[index].file)
        stored, digest, files = read_crop_manifest(directory)
        if digest != self.digest:
            raise InputError(f"dataset: {directory} has crops of other views; delete it and render the crops again")
        if stored < size:
            raise InputError(
                f"dataset: {directory} has crops of {stored} pixels; expected at least {size}; delete it and render "
                f"with --crops {size}"
            )
        content = intact_content(directory, name, files.get(name, ""))
        if content is None:
            raise InputError(
                f"dataset: {directory / name} is missing or damaged; repeat `thor2 render` with --crops to restore it"
            )
        with np.load(io.BytesIO(content)) as arrays:
            return ViewCrops(arrays["color"], arrays["normals"]).reduced(size)
