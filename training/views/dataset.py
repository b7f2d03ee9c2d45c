"""Datasets of normalized views on disk, rendered from meshes and read by training.

    job = RenderJob(find_meshes("meshes"))
    dataset = render_dataset(job, "views", pool=local_workers(2))     # later: ViewDataset.open("views")
    dataset.classes, len(dataset)
    for index in range(len(dataset.shards)):
        views = dataset.read(index)                # views.xyz, views.rgb, views.counts, views.label

A dataset contains normalized point clouds, not images: for each object, one cloud per camera angle as rendered (`copy`
0) and, if the job has augmentations, its augmented copies (`copy` 1, 2, ...), which are seen from random cameras. Views
with too few points are left out. Its directory has `manifest.json` and shards, safetensors files with views of one
object:

    xyz     [n, 3] uint16   points of all views, one view after the other, in `COORDINATE_STEP` scaled units
    rgb     [n, 3] uint8    sRGB
    counts  [V] int64       number of points of each view
    view    [V] int32       index of the view among all views of the object
    copy    [V] int32       0 is the view as rendered, others are augmented copies
    camera  [V, 3] float32  position of the camera, scaled units; missing in datasets of earlier versions

`surfaces.safetensors` has the surfaces of the objects (`thor2_jax.surfaces`); datasets of earlier versions lack this
file.

The manifest contains the job, that is, everything that determines the views, and the finished shards and the surfaces
with their checksums. It contains no time stamps, so the same job always gives the same bytes.

Worker processes render the views. This process normalizes and writes the shards one by one, in a fixed order.
Therefore, the bytes do not depend on the workers, and an interrupted rendering resumes at the first missing shard.

Image networks are trained on crops of the same views, for which they are rendered once more. The dataset and its digest
do not change: crops may be added to views that runs were trained on.

    render_crops(job, dataset, size=96, pool=local_workers(2))
    crops = dataset.read_crops(index, 96)          # one crop for each cloud of `read(index)`

    DATASET/crops/manifest.json     size of the crops, digest of the dataset, checksums of the files
    DATASET/crops/*.npz             one file for each shard, with compressed `color` and `normals`
"""

import contextlib
import dataclasses
import functools
import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.errors import InputError, decoding, refusing_os_errors, with_context
from thor2_jax.files import check_output_directory, content_digest, locked, read_file, remove_written, write_text
from thor2_jax.surfaces.surfaces import SURFACES_FILE, Surfaces
from thor2_jax.types import Cloud
from training.objects.surfaces import surfaces_of
from training.storage.jobs import MANIFEST, Progress, check_same_job, intact_content, write_checked
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views.crops import CROPS, CROPS_FORMAT, ViewCrops, crops_of, read_crop_manifest
from training.views.mesh_views import COORDINATE_STEP, RenderJob, render_task
from training.views.normalized_views import NormalizedViews, normalize_views

__all__ = ["Shard", "ViewDataset", "encode", "remove_views", "render_crops", "render_dataset"]

MANIFEST_FORMAT = 2


def remove_views(directory: Path) -> None:
    """Remove a dataset of views and their crops; files that `thor2 render` did not write are kept."""
    with contextlib.suppress(OSError, InputError):
        ViewDataset.read_manifest(directory)
        names = r"(manifest\.json|\.lock|[0-9]{4,}-[0-9]{4,}\.(safetensors|npz)|surfaces\.safetensors)"
        remove_written(directory, rf"({CROPS}/)?{names}")


def encode(views: NormalizedViews) -> bytes:
    """Return the bytes of a shard's file."""
    steps = (views.xyz / np.float32(COORDINATE_STEP)).astype(np.uint16)
    others = {name: getattr(views, name) for name in ("rgb", "counts", "view", "copy", "camera")}
    return safetensors.numpy.save({"xyz": steps, **others})


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

    @property
    def crops(self) -> str:
        """File name of its crops, in their directory."""
        return Path(self.file).with_suffix(".npz").name


def _dump(table: Mapping[str, Any]) -> str:
    return json.dumps(table, indent=1) + "\n"


@dataclasses.dataclass(frozen=True)
class ViewDataset:
    """A dataset, which may be unfinished unless it comes from `open`; its length is the number of clouds.

    Attributes:
        directory: path of the dataset.
        job: everything that determines the views, in JSON types. `objects` is a list of tables with `name` and `mesh`
            (the mesh's checksum); `shards` is the number of shards.
        shards: finished shards, ordered by class and view.
        surfaces_sha256: checksum of the file of the surfaces; None without this file.
    """

    directory: Path
    job: Mapping[str, Any]
    shards: tuple[Shard, ...] = ()
    surfaces_sha256: str | None = None

    @classmethod
    def open(cls, path: str | Path) -> "ViewDataset":
        """Open a dataset written by `render_dataset`; shards are read and checked by `read`.

        Raises:
            InputError: the directory or its manifest is missing, the manifest is damaged or of another format or
                descriptor version, or the rendering is not finished.
        """
        directory, manifest = Path(path), Path(path) / MANIFEST
        if not directory.is_dir():
            raise InputError(f"dataset: {directory} is not a directory; expected the output of `thor2 render`")
        with refusing_os_errors(f"dataset: {manifest} cannot be read", "expected output of `thor2 render`"):
            dataset = cls.read_manifest(directory)
        version, n_shards = dataset.job["descriptor_version"], dataset.job["shards"]
        if version != DESCRIPTOR_VERSION:
            raise InputError(
                f"dataset: {manifest} has views for descriptor version {version}; expected version "
                f"{DESCRIPTOR_VERSION}; render the views again"
            )
        if len(dataset.shards) != n_shards:
            raise InputError(
                f"dataset: {manifest} lists {len(dataset.shards)} of {n_shards} shards; repeat the `thor2 render` "
                "command to finish it"
            )
        return dataset

    @classmethod
    def read_manifest(cls, directory: Path) -> "ViewDataset":
        """Read the manifest of a dataset that may be unfinished.

        Raises:
            InputError: the manifest is damaged or has another format.
            OSError: the manifest cannot be read.
        """
        path = directory / MANIFEST
        content = read_file(path)
        with decoding(f"dataset: {path} is damaged", advice="render it again"):
            table = json.loads(content)
            if table["format"] == MANIFEST_FORMAT:
                checksum = table.pop("sha256")
                if checksum != content_digest([_dump(table)]):
                    raise ValueError("its checksum differs")
                shards = tuple(Shard(**shard) for shard in table["shards"])
                return cls(directory, table["job"], shards, table.get("surfaces"))
        raise InputError(f"dataset: {path} has format {table['format']!r}; expected {MANIFEST_FORMAT}; render it again")

    @functools.cached_property
    def manifest(self) -> str:
        """The content of the manifest."""
        table = {
            "format": MANIFEST_FORMAT,
            "views": len(self),
            "left_out": self.left_out,
            "job": self.job,
            "shards": [dataclasses.asdict(shard) for shard in self.shards],
            **({} if self.surfaces_sha256 is None else {"surfaces": self.surfaces_sha256}),
        }
        return _dump({**table, "sha256": content_digest([_dump(table)])})

    @property
    def digest(self) -> str:
        """SHA-256 of the manifest, which contains the checksums of all shards."""
        return content_digest([self.manifest])

    def __len__(self) -> int:
        return sum(shard.views for shard in self.shards)

    @property
    def left_out(self) -> int:
        """Number of clouds that were left out, over all shards."""
        return sum(shard.left_out for shard in self.shards)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the objects; labels are indices into this tuple."""
        return tuple(entry["name"] for entry in self.job["objects"])

    @property
    def record(self) -> Mapping[str, Any]:
        """Description of the dataset for the record of a run, in JSON types."""
        return {"digest": self.digest, "views": len(self), "left_out": self.left_out, "job": self.job}

    @functools.cached_property
    def surfaces(self) -> Surfaces | None:
        """Surfaces of the classes; None in datasets of earlier versions.

        Raises:
            InputError: their file is missing or damaged.
        """
        digest = self.surfaces_sha256
        return None if digest is None else Surfaces.of_content(self.content(SURFACES_FILE, digest))

    def content(self, file: str, digest: str, command: str = "`thor2 render`") -> bytes:
        """Return the bytes of a file; raise InputError, which says to repeat the command, if it is not intact."""
        if (content := intact_content(self.directory, file, digest)) is None:
            raise InputError(f"dataset: {self.directory / file} is missing or damaged; repeat {command} to restore it")
        return content

    def read(self, index: int) -> NormalizedViews:
        """Read the views of a shard.

        Raises:
            InputError: the shard's file is missing or damaged.
        """
        shard = self.shards[index]
        arrays = safetensors.numpy.load(self.content(shard.file, shard.sha256))
        xyz = arrays.pop("xyz").astype(np.float32) * np.float32(COORDINATE_STEP)
        arrays.setdefault("camera", np.zeros((len(arrays["counts"]), 3), np.float32))
        return NormalizedViews(xyz, label=shard.label, **arrays)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of a shard's views, in their order.

        Args:
            index: index of the shard.
            size: side of the crops, pixels; larger stored crops are reduced.

        Raises:
            InputError: the dataset has no crops or smaller ones, or a file is missing or damaged.
        """
        directory, name = self.directory / CROPS, self.shards[index].crops
        stored, files = read_crop_manifest(directory)
        if stored["dataset"] != self.digest:
            raise InputError(f"dataset: {directory} has crops of other views; delete it and render the crops again")
        if stored["crops"] < size:
            raise InputError(
                f"dataset: {directory} has crops of {stored['crops']} pixels; expected at least {size}; delete it and "
                f"render with --crops {size}"
            )
        content = self.content(f"{CROPS}/{name}", files.get(name, ""), "`thor2 render` with --crops")
        with np.load(io.BytesIO(content)) as arrays:
            return ViewCrops(arrays["color"], arrays["normals"]).reduced(size)


def _begin(directory: Path, job: Mapping[str, Any]) -> ViewDataset:
    """Return the dataset with its intact shards; write the manifest if it is missing or lists damaged shards.

    Raises:
        InputError: the directory holds another job.
        OSError: the directory cannot be written.
    """
    exists = (directory / MANIFEST).exists()
    stored = ViewDataset.read_manifest(directory) if exists else ViewDataset(directory, job)
    check_same_job(directory, stored.job, job)
    intact = (shard for shard in stored.shards if intact_content(directory, shard.file, shard.sha256) is not None)
    dataset = dataclasses.replace(stored, shards=tuple(intact))
    if dataset != stored or not exists:
        write_text(directory / MANIFEST, dataset.manifest)
    return dataset


def _store(path: Path, label: int, planned: int, rendered: Sequence[tuple[int, int, Cloud]]) -> Shard:
    """Normalize the clouds of a shard and write its file; `planned` is the number including left-out clouds.

    Raises:
        InputError: a cloud cannot be normalized or stored.
        OSError: the file cannot be written.
    """
    numbers = [number for number, _, _ in rendered], [copy for _, copy, _ in rendered]
    views = normalize_views([cloud for _, _, cloud in rendered], label, *numbers, DescriptorConfig())
    digest, n_views = write_checked(path, encode(views)), len(views)
    return Shard(path.name, digest, label, n_views, left_out=planned - n_views, points=len(views.xyz))


def render_dataset(
    job: RenderJob,
    out: str | Path,
    pool: WorkerPool = IN_PROCESS,
    progress: Progress = lambda stage, done, total, note: None,
) -> ViewDataset:
    """Render views of every object, normalize them and write them to a dataset; resume an interrupted rendering.

    A resumed rendering renders missing and damaged shards. The final dataset has the same bytes as without the
    interruption. At any time, memory holds one shard per worker and one more.

    Args:
        job: the job.
        out: directory: new, empty, or with a dataset of the same job; created with its parents.
        pool: worker processes that render; they do not affect the result.
        progress: called with ("surfaces", objects done, number of objects, name) if the surfaces are computed, then
            with ("render", clouds done, total clouds, "") at the start and after each shard.

    Raises:
        InputError: `out` holds something else or views of another job (the message names the difference), or another
            process writes to it; also as `RenderJob.record`. Nothing is written then.
        OSError: `out` cannot be written; the rendering can be resumed.
    """
    out = Path(out)
    check_output_directory(out, MANIFEST)
    record, labels = job.record(), {name: label for label, name in enumerate(job.meshes)}
    total = len(labels) * len(job.angles) * job.copies
    with locked(out):
        dataset = _begin(out, record)
        done = {shard.file: shard for shard in dataset.shards}
        digest = dataset.surfaces_sha256
        is_missing = digest is not None and intact_content(out, SURFACES_FILE, digest) is None
        if is_missing or not (digest or done):  # a dataset of an earlier version has shards and no surfaces
            digest = write_checked(out / SURFACES_FILE, surfaces_of(job.read_meshes(progress)).content)
            dataset = dataclasses.replace(dataset, surfaces_sha256=digest)
            write_text(out / MANIFEST, dataset.manifest)
        progress("render", len(dataset) + dataset.left_out, total, "")
        missing = [file for file in job.shards if file not in done]
        with contextlib.closing(pool(render_task, job.tasks(missing, record["objects"]))) as results:
            for file, rendered in zip(missing, results, strict=True):
                name, views = job.shards[file]
                with with_context(f"object {name!r}"):
                    done[file] = _store(out / file, labels[name], job.copies * len(views), rendered)
                dataset = dataclasses.replace(dataset, shards=tuple(done[each] for each in job.shards if each in done))
                write_text(out / MANIFEST, dataset.manifest)
                progress("render", len(dataset) + dataset.left_out, total, "")
    return dataset


def render_crops(
    job: RenderJob,
    dataset: ViewDataset,
    size: int,
    pool: WorkerPool = IN_PROCESS,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> None:
    """Render the crops of all views of a dataset; an interrupted rendering resumes.

    Args:
        job: the job of the dataset.
        dataset: the dataset.
        size: side of the crops, pixels, at least 1.
        pool: worker processes that render; does not affect the result.
        progress: called with (crops done, total crops) at the start and after each shard.

    Raises:
        InputError: the directory of the crops has crops of another size or of other views, or files of the user.
        OSError: a file cannot be written; the rendering can be resumed.
    """
    directory, done = dataset.directory / CROPS, dict[str, str]()  # file name -> checksum
    with locked(directory):
        check_output_directory(directory, MANIFEST)
        if (directory / MANIFEST).is_file():
            stored, files = read_crop_manifest(directory)
            check_same_job(directory, stored, {"crops": size, "dataset": dataset.digest})
            done = {name: sha for name, sha in files.items() if intact_content(directory, name, sha) is not None}
        missing = [index for index, shard in enumerate(dataset.shards) if shard.crops not in done]
        n_done = len(dataset) - sum(dataset.shards[index].views for index in missing)
        progress(n_done, len(dataset))
        tasks = job.tasks((dataset.shards[index].file for index in missing), dataset.job["objects"])
        with contextlib.closing(pool(functools.partial(crops_of, size=size), tasks)) as results:
            for index, rendered in zip(missing, results, strict=True):
                views, name = dataset.read(index), dataset.shards[index].crops
                of_shard = [rendered[key] for key in zip(views.view.tolist(), views.copy.tolist(), strict=True)]
                done[name] = write_checked(directory / name, ViewCrops.stacked(of_shard, size).content)
                files = dict(sorted(done.items()))
                content = {"format": CROPS_FORMAT, "size": size, "dataset": dataset.digest, "files": files}
                write_text(directory / MANIFEST, json.dumps(content) + "\n")
                n_done += len(views)
                progress(n_done, len(dataset))
