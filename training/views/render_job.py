"""Render meshes to a dataset of normalized views on disk, which `ViewDataset` reads.

    job = RenderJob(find_meshes("meshes"))
    dataset = render_dataset(job, "views", pool=local_workers(2))

Worker processes render; this process normalizes and writes the shards one by one, in a fixed order. The bytes therefore
do not depend on the workers, and an interrupted rendering resumes at the first missing shard.

    render_crops(job, dataset, size=96, pool=local_workers(2))

renders the views of a dataset once more, for the crops that image networks are trained on. The dataset and its digest
do not change: crops may be added to views that runs were trained on.
"""

import contextlib
import dataclasses
import functools
import itertools
import operator
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.errors import InputError, with_context
from thor2_jax.files import atomic_write, check_output_directory, content_digest
from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL
from thor2_jax.types import Cloud
from training.augmentation.augmentations import Augmentations
from training.objects.mesh import TexturedMesh
from training.rendering.camera import DISTANCE, TRAINING_CAMERA, view_angles
from training.storage.jobs import check_same_job, locked
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views import mesh_views
from training.views.crops import CROP_SIZE, QuantizedCrop, quantized, rgbd_crop, stacked
from training.views.dataset import (
    CROPS,
    MANIFEST,
    Manifest,
    Shard,
    ViewDataset,
    crop_file,
    encode,
    encode_crops,
    intact_content,
    read_crop_manifest,
    write_crop_manifest,
)
from training.views.mesh_views import SIGMA_S, RenderProgress, ViewTask, clouds_per_view
from training.views.normalized_views import COORDINATE_STEP, MAX_VIEW_LENGTH, normalize_views

__all__ = ["RenderJob", "render_crops", "render_dataset"]

CLOUDS_PER_SHARD = 256
"""Clouds per shard, rounded down to whole views: a few megabytes, about a second of rendering."""


@dataclasses.dataclass(frozen=True)
class RenderJob:
    """Everything that determines a dataset of views.

    Attributes:
        meshes: object name -> mesh file, as from `find_meshes`, or mesh.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.
        augmentations: adds augmented copies of each view; None adds none.
        seed: seed for the augmentations, at least 0. The copies of an object do not depend on the other objects.
    """

    meshes: Mapping[str, Path | TexturedMesh]
    azimuth_step: float = 5.0
    polar_step: float = 5.0
    augmentations: Augmentations | None = None
    seed: int = 0

    @property
    def angles(self) -> NDArray[np.float64]:
        """Azimuth and polar angle [n, 2] of the views of an object; raises InputError for an invalid step."""
        return view_angles(self.azimuth_step, self.polar_step)

    @property
    def copies(self) -> int:
        """Number of clouds of a view."""
        return clouds_per_view(self.augmentations)

    @functools.cached_property
    def shards(self) -> dict[str, tuple[str, range]]:
        """File name -> object and numbers of the views of each shard."""
        size, n_views = max(1, CLOUDS_PER_SHARD // self.copies), len(self.angles)
        return {
            f"{label:04d}-{number:04d}.safetensors": (name, range(first, min(first + size, n_views)))
            for label, name in enumerate(self.meshes)
            for number, first in enumerate(range(0, n_views, size))
        }

    def record(self) -> dict[str, Any]:
        """Check the job and return it as JSON holds it.

        Raises:
            InputError: there are no meshes, a mesh is unreadable, too large or never visible, or a step or the seed is
                invalid.
        """
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; it must be at least 0")
        augmentations, camera = self.augmentations, TRAINING_CAMERA
        objects = [
            {"name": name, "mesh": _checked_size(name, mesh).digest}
            for name, mesh in mesh_views.checked_meshes(self.meshes, self.angles)
        ]
        # Without the fields that this camera has no value for: datasets of version 0.1.0 do not have them.
        intrinsics = {name: value for name, value in dataclasses.asdict(camera.intrinsics).items() if value}
        return {
            "descriptor_version": DESCRIPTOR_VERSION,
            "sigma_s": SIGMA_S,
            "voxel": DESCRIPTOR_VOXEL,
            "step": COORDINATE_STEP,
            "min_points": mesh_views.MIN_VIEW_POINTS,
            "camera": {"width": camera.width, "height": camera.height, "intrinsics": intrinsics, "distance": DISTANCE},
            "azimuth_step": float(self.azimuth_step),
            "polar_step": float(self.polar_step),
            "variations": {"seed": self.seed, "cameras": "random", **augmentations.record()} if augmentations else None,
            "objects": objects,
            "shards": len(self.shards),
        }

    def tasks(self, files: Iterable[str]) -> Iterator[ViewTask]:
        """Yield the task of each of these shards; a mesh is read once for consecutive shards of its object."""
        angles = self.angles
        for name, group in itertools.groupby(map(self.shards.__getitem__, files), key=operator.itemgetter(0)):
            mesh = mesh_views.read_mesh(self.meshes[name])
            for _, views in group:
                of_views = angles[views.start : views.stop]
                yield ViewTask(name, mesh, of_views, views.start, self.augmentations, self.seed)


def _checked_size(name: str, mesh: TexturedMesh) -> TexturedMesh:
    """Return a mesh unless its views may be too large to be stored."""
    diameter = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    if SIGMA_S * diameter > MAX_VIEW_LENGTH:
        raise InputError(
            f"object {name!r} has a diameter of {diameter:.2f} m; at most {MAX_VIEW_LENGTH / SIGMA_S:.2f} m can be "
            "stored; scale the mesh to metres"
        )
    return mesh


def _begin(directory: Path, job: Mapping[str, Any]) -> Manifest:
    """Return the manifest with the intact shards; write it if it is missing or lists damaged shards.

    Raises:
        InputError: The directory holds another job.
        OSError: The directory cannot be written.
    """
    path = directory / MANIFEST
    stored = Manifest.parse(path.read_bytes(), path) if path.exists() else None
    if stored:
        check_same_job(directory, stored.job, job)
    shards = stored.shards if stored else ()
    is_intact = [intact_content(directory, shard.file, shard.sha256) is not None for shard in shards]
    manifest = Manifest(job, tuple(itertools.compress(shards, is_intact)))
    if manifest != stored:
        manifest.write(directory)
    return manifest


def _write(path: Path, content: bytes) -> str:
    """Write a file and return its SHA-256."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return content_digest([content])


def _store(path: Path, label: int, planned: int, rendered: Sequence[tuple[int, int, Cloud]]) -> Shard:
    """Normalize the clouds of a shard and write its file; `planned` counts those left out, too.

    Raises:
        InputError: A cloud cannot be normalized or stored.
        OSError: The file cannot be written.
    """
    numbers = [number for number, _, _ in rendered], [copy for _, copy, _ in rendered]
    views = normalize_views([cloud for _, _, cloud in rendered], label, *numbers, DescriptorConfig())
    digest, n_views = _write(path, encode(views)), len(views)
    return Shard(path.name, digest, label, n_views, left_out=planned - n_views, points=len(views.xyz))


def render_dataset(
    job: RenderJob,
    out: str | Path,
    pool: WorkerPool = IN_PROCESS,
    progress: RenderProgress = lambda done, total: None,
) -> ViewDataset:
    """Render views of every object, normalize them and write them to a dataset; resume an interrupted rendering.

    A resumed rendering renders what is missing or damaged; the dataset ends up with the same bytes as without the
    interruption. Memory holds one shard per worker, and one.

    Args:
        job: the job.
        out: directory: new, empty, or with a dataset of the same job; created with its parents.
        pool: worker processes that render; does not affect the result.
        progress: called with (clouds done, total clouds) at the start and after each shard.

    Raises:
        InputError: Nothing is written if the job is invalid, see `RenderJob.record`, or `out` holds something else,
            views of another job (names what differs) or is written by another process.
        OSError: `out` cannot be written; the rendering can be resumed.
    """
    out = Path(out)
    check_output_directory(out, MANIFEST)
    record, labels = job.record(), {name: label for label, name in enumerate(job.meshes)}
    total = len(labels) * len(job.angles) * job.copies
    with locked(out):
        done = {shard.file: shard for shard in _begin(out, record).shards}
        progress(_clouds(done), total)
        missing = [file for file in job.shards if file not in done]
        with contextlib.closing(pool(mesh_views.render_task, job.tasks(missing))) as results:
            for file, rendered in zip(missing, results, strict=True):
                name, views = job.shards[file]
                with with_context(f"object {name!r}"):
                    done[file] = _store(out / file, labels[name], job.copies * len(views), rendered)
                Manifest(record, tuple(done[file] for file in job.shards if file in done)).write(out)
                progress(_clouds(done), total)
    return ViewDataset.open(out)


def _clouds(shards: Mapping[str, Shard]) -> int:
    return sum(shard.views + shard.left_out for shard in shards.values())


def _crops_of_task(task: ViewTask, size: int) -> dict[tuple[int, int], QuantizedCrop]:
    """Return (number of the view, of the copy) -> crop of the views of a task in which something is visible."""
    return {
        (number, copy): quantized(rgbd_crop(view.frame, 1, size))
        for number, copy, view in mesh_views.all_views(task)
        if view.depth.any()
    }


def _begin_crops(directory: Path, dataset: ViewDataset, size: int) -> dict[str, str]:
    """Return the intact files of an interrupted rendering, file name -> checksum.

    Raises:
        InputError: the crops have another size, or are of another dataset.
    """
    check_output_directory(directory, MANIFEST)
    if not (directory / MANIFEST).is_file():
        return {}
    stored_size, digest, files = read_crop_manifest(directory)
    requested = {"crops": size, "dataset": dataset.digest}
    check_same_job(directory, {"crops": stored_size, "dataset": digest}, requested)
    return {name: sha for name, sha in files.items() if intact_content(directory, name, sha) is not None}


def render_crops(
    job: RenderJob,
    dataset: ViewDataset,
    size: int = CROP_SIZE,
    pool: WorkerPool = IN_PROCESS,
    progress: RenderProgress = lambda done, total: None,
) -> None:
    """Render the crops of all views of a dataset; an interrupted rendering resumes.

    Args:
        job: the job of the dataset.
        dataset: the dataset.
        size: side of the crops, pixels, at least 1.
        pool: worker processes that render; does not affect the result.
        progress: called with (crops done, total crops) at the start and after each shard.

    Raises:
        InputError: the dataset has crops of another size.
        OSError: a file cannot be written; the rendering can be resumed.
    """
    directory = dataset.directory / CROPS
    with locked(directory):
        done = _begin_crops(directory, dataset, size)
        missing = [index for index, shard in enumerate(dataset.shards) if crop_file(shard.file) not in done]
        n_done = len(dataset) - sum(dataset.shards[index].views for index in missing)
        progress(n_done, len(dataset))
        tasks = job.tasks(dataset.shards[index].file for index in missing)
        with contextlib.closing(pool(functools.partial(_crops_of_task, size=size), tasks)) as results:
            for index, rendered in zip(missing, results, strict=True):
                views, name = dataset.read(index), crop_file(dataset.shards[index].file)
                of_shard = [rendered[key] for key in zip(views.view.tolist(), views.copy.tolist(), strict=True)]
                done[name] = _write(directory / name, encode_crops(stacked(of_shard, size)))
                write_crop_manifest(directory, size, dataset.digest, dict(sorted(done.items())))
                n_done += len(views)
                progress(n_done, len(dataset))
