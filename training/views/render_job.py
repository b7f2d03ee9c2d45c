"""Render meshes to a dataset of normalized views on disk, which `ViewDataset` reads.

    dataset = render_dataset(find_meshes("meshes"), "views", pool=local_workers(2))

Worker processes render; this process normalizes and writes the shards one by one, in a fixed order. The bytes therefore
do not depend on the workers, and an interrupted rendering resumes at the first missing shard.

    render_crops(meshes, ViewDataset.open("views"), size=96, pool=local_workers(2))

renders the views of a dataset once more, for the crops that image networks are trained on. The dataset and its digest
do not change: crops may be added to views that runs were trained on.
"""

import contextlib
import dataclasses
import functools
import hashlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.errors import InputError, with_context
from thor2_jax.files import atomic_write, check_output_directory, content_digest, remove_leftovers
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL
from training.augmentation.augmentations import Augmentations
from training.objects.mesh import TexturedMesh
from training.rendering.view_sphere import DISTANCE, TRAINING_CAMERA, view_angles
from training.storage.jobs import check_same_job, locked
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views import crops, mesh_views
from training.views.crops import CROP_SIZE, CropManifest, QuantizedCrop, crop_file, intact_content
from training.views.dataset import MANIFEST, Manifest, Shard, ViewDataset, encode
from training.views.mesh_views import SIGMA_S, RenderProgress, ViewTask, clouds_per_view, view_tasks
from training.views.normalized_views import COORDINATE_STEP, MAX_VIEW_LENGTH, normalize_views

__all__ = ["dataset_job", "mesh_digest", "render_crops", "render_dataset"]

CLOUDS_PER_SHARD = 256
"""Clouds per shard, rounded down to whole views: a few megabytes, about a second of rendering."""

SUFFIX = ".safetensors"


def mesh_digest(mesh: TexturedMesh) -> str:
    """Return the SHA-256 of a mesh's arrays: mesh files refer to others, and meshes need not come from files."""
    parts: list[str | bytes] = []
    for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.face_texture, mesh.corner_colors, *mesh.textures):
        parts += ["False"] if array is None else [repr((array.dtype.str, array.shape)), array.tobytes()]
    return content_digest(parts)


def _objects(meshes: Mapping[str, Path | TexturedMesh], angles: NDArray[np.float64]) -> list[dict[str, str]]:
    """Check every mesh and return the names and digests of the objects."""
    objects = []
    for name, mesh in mesh_views.checked_meshes(meshes, angles):
        diameter = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        if SIGMA_S * diameter > MAX_VIEW_LENGTH:
            raise InputError(
                f"object {name!r} has a diameter of {diameter:.2f} m; at most {MAX_VIEW_LENGTH / SIGMA_S:.2f} m can be "
                "stored; scale the mesh to metres"
            )
        objects.append({"name": name, "mesh": mesh_digest(mesh)})
    return objects


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
    remove_leftovers(directory)
    shards = stored.shards if stored else ()
    is_intact = [intact_content(directory, shard.file, shard.sha256) is not None for shard in shards]
    manifest = Manifest(job, tuple(itertools.compress(shards, is_intact)))
    if manifest != stored:
        manifest.write(directory)
    return manifest


def _store(path: Path, label: int, planned: int, rendered: Sequence[mesh_views.ViewCloud]) -> Shard:
    """Normalize the clouds of a shard and write its file; `planned` counts those left out, too.

    Raises:
        InputError: A cloud cannot be normalized or stored.
        OSError: The file cannot be written.
    """
    clouds = [(cloud.xyz, cloud.rgb) for cloud in rendered]
    numbers = [cloud.view for cloud in rendered], [cloud.copy for cloud in rendered]
    views = normalize_views(clouds, label, *numbers, DescriptorConfig())
    content = encode(views)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    digest, n_views = hashlib.sha256(content).hexdigest(), len(views)
    return Shard(path.name, digest, label, n_views, left_out=planned - n_views, points=len(views.xyz))


@dataclasses.dataclass(frozen=True)
class ShardPlan:
    """Which views each shard of a dataset holds.

    Attributes:
        angles: [n, 2] azimuth and polar angle of every view of an object.
        copies: clouds per view.
        names: of the objects.
    """

    angles: NDArray[np.float64]
    copies: int
    names: tuple[str, ...]

    @property
    def size(self) -> int:
        """Views per shard."""
        return max(1, CLOUDS_PER_SHARD // self.copies)

    @property
    def clouds(self) -> int:
        """Clouds in all shards, with those that will be left out."""
        return self.copies * len(self.angles) * len(self.names)

    @functools.cached_property
    def shards(self) -> dict[str, tuple[int, int]]:
        """File name -> label and index of the first view."""
        return {
            f"{label:04d}-{number:04d}{SUFFIX}": (label, first)
            for label in range(len(self.names))
            for number, first in enumerate(range(0, len(self.angles), self.size))
        }


def dataset_job(
    meshes: Mapping[str, Path | TexturedMesh],
    azimuth_step: float,
    polar_step: float,
    augmentations: Augmentations | None,
    seed: int,
) -> dict[str, Any]:
    """Return everything that determines a dataset, as JSON holds it; see `render_dataset` for the arguments.

    Raises:
        InputError: An argument is invalid.
    """
    if seed < 0:
        raise InputError(f"seed is {seed}; it must be at least 0")
    angles = view_angles(azimuth_step, polar_step)
    objects = _objects(meshes, angles)
    plan = ShardPlan(angles, clouds_per_view(augmentations), tuple(entry["name"] for entry in objects))
    camera = TRAINING_CAMERA
    # Without the fields that this camera has no value for: datasets of version 0.1.0 do not have them.
    intrinsics = {name: value for name, value in dataclasses.asdict(camera.intrinsics).items() if value}
    return {
        "descriptor_version": DESCRIPTOR_VERSION,
        "sigma_s": SIGMA_S,
        "voxel": DESCRIPTOR_VOXEL,
        "step": COORDINATE_STEP,
        "min_points": mesh_views.MIN_VIEW_POINTS,
        "camera": {"width": camera.width, "height": camera.height, "intrinsics": intrinsics, "distance": DISTANCE},
        "azimuth_step": float(azimuth_step),
        "polar_step": float(polar_step),
        "variations": {"seed": seed, "cameras": "random", **augmentations.record()} if augmentations else None,
        "objects": objects,
        "shards": len(plan.shards),
    }


def render_dataset(
    meshes: Mapping[str, Path | TexturedMesh],
    out: str | Path,
    azimuth_step: float = 5.0,
    polar_step: float = 5.0,
    pool: WorkerPool = IN_PROCESS,
    progress: RenderProgress = lambda done, total: None,
    augmentations: Augmentations | None = None,
    seed: int = 0,
) -> ViewDataset:
    """Render views of every object, normalize them and write them to a dataset; resume an interrupted rendering.

    A resumed rendering renders what is missing or damaged; the dataset ends up with the same bytes as without the
    interruption. Memory holds one shard per worker, and one.

    Args:
        meshes: object name -> mesh file, as from `find_meshes`, or mesh.
        out: directory: new, empty, or with a dataset of the same arguments; created with its parents.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.
        pool: worker processes that render; does not affect the result.
        progress: called with (clouds done, total clouds) at the start and after each shard.
        augmentations: adds augmented copies of each view; None adds none.
        seed: seed for the augmentations. The copies of an object do not depend on the other objects.

    Raises:
        InputError: Nothing is written if there are no meshes, a mesh is unreadable, too large or never visible, a step
            or the seed is invalid, or `out` holds something else, views of other arguments (names what differs) or is
            written by another process.
        OSError: `out` cannot be written; the rendering can be resumed.
    """
    out = Path(out)
    check_output_directory(out, MANIFEST)
    job = dataset_job(meshes, azimuth_step, polar_step, augmentations, seed)
    angles = view_angles(azimuth_step, polar_step)
    plan = ShardPlan(angles, clouds_per_view(augmentations), tuple(entry["name"] for entry in job["objects"]))
    with locked(out):
        done = {shard.file: shard for shard in _begin(out, job).shards}
        progress(_clouds(done), plan.clouds)
        missing = [file for file in plan.shards if file not in done]
        starts = [(plan.names[label], first) for label, first in (plan.shards[file] for file in missing)]
        tasks = view_tasks(meshes, angles, starts, plan.size, augmentations, seed)
        with contextlib.closing(pool(mesh_views.render_task, tasks)) as results:
            for file, rendered in zip(missing, results, strict=True):
                label, first = plan.shards[file]
                planned = plan.copies * len(angles[first : first + plan.size])
                with with_context(f"object {plan.names[label]!r}"):
                    done[file] = _store(out / file, label, planned, rendered)
                Manifest(job, tuple(done[name] for name in plan.shards if name in done)).write(out)
                progress(_clouds(done), plan.clouds)
    return ViewDataset.open(out)


def _clouds(shards: Mapping[str, Shard]) -> int:
    return sum(shard.views + shard.left_out for shard in shards.values())


def _crops_of_task(task: ViewTask, size: int) -> dict[tuple[int, int], QuantizedCrop]:
    """Return (number of the view, of the copy) -> crop of the views of a task in which something is visible."""
    of_task = {}
    for number, copy, view in mesh_views.all_views(task):
        labels = (view.depth > 0).astype(np.uint8)
        if labels.any():
            frame = RGBDFrame(view.color, view.depth, labels, view.intrinsics)
            of_task[number, copy] = crops.quantized(crops.rgbd_crop(frame, 1, size))
    return of_task


def _begin_crops(directory: Path, dataset: ViewDataset, size: int) -> dict[str, str]:
    """Return the intact files of an interrupted rendering, file name -> checksum.

    Raises:
        InputError: the crops have another size, or are of another dataset.
    """
    check_output_directory(directory, MANIFEST)
    if not (directory / MANIFEST).is_file():
        return {}
    stored, requested = CropManifest.read(directory), {"crops": size, "dataset": dataset.digest}
    check_same_job(directory, {"crops": stored.size, "dataset": stored.dataset}, requested)
    remove_leftovers(directory)
    return {name: sha for name, sha in stored.files.items() if intact_content(directory, name, sha) is not None}


def _of_shard(
    dataset: ViewDataset, index: int, rendered: Mapping[tuple[int, int], QuantizedCrop], size: int
) -> crops.ViewCrops:
    """Return the crops of the clouds of a shard, in their order."""
    views = dataset.read(index)
    keys = list(zip(views.view.tolist(), views.copy.tolist(), strict=True))
    missing = [key for key in keys if key not in rendered]
    if missing:
        raise InputError(
            f"meshes: view {missing[0][0]} of {dataset.classes[views.label]!r} is in {dataset.directory}, but is empty "
            "now; give the meshes of the dataset"
        )
    return crops.stacked([rendered[key] for key in keys], size)


def render_crops(
    meshes: Mapping[str, Path | TexturedMesh],
    dataset: ViewDataset,
    size: int = CROP_SIZE,
    pool: WorkerPool = IN_PROCESS,
    progress: RenderProgress = lambda done, total: None,
    augmentations: Augmentations | None = None,
    seed: int = 0,
) -> None:
    """Render the crops of all views of a dataset; an interrupted rendering resumes.

    Args:
        meshes: the meshes of the dataset.
        dataset: the dataset.
        size: side of the crops, pixels, at least 1.
        pool: worker processes that render; does not affect the result.
        progress: called with (crops done, total crops) at the start and after each shard.
        augmentations: those of the dataset.
        seed: seed of the dataset.

    Raises:
        InputError: the dataset has crops of another size or views of other meshes.
        OSError: a file cannot be written; the rendering can be resumed.
    """
    directory = dataset.directory / crops.CROPS
    job = dataset.manifest.job
    angles = view_angles(job["azimuth_step"], job["polar_step"])
    plan = ShardPlan(angles, clouds_per_view(augmentations), dataset.classes)
    with locked(directory):
        done = _begin_crops(directory, dataset, size)
        missing = [index for index, shard in enumerate(dataset.shards) if crop_file(shard.file) not in done]
        total = sum(shard.views for shard in dataset.shards)
        n_done = total - sum(dataset.shards[index].views for index in missing)
        progress(n_done, total)
        places = [plan.shards[dataset.shards[index].file] for index in missing]
        starts = [(dataset.classes[label], first) for label, first in places]
        tasks = view_tasks(meshes, angles, starts, plan.size, augmentations, seed)
        with contextlib.closing(pool(functools.partial(_crops_of_task, size=size), tasks)) as results:
            for index, rendered in zip(missing, results, strict=True):
                name = crop_file(dataset.shards[index].file)
                content = crops.encode_crops(_of_shard(dataset, index, rendered, size))
                with atomic_write(directory / name) as temporary:
                    temporary.write_bytes(content)
                done[name] = hashlib.sha256(content).hexdigest()
                CropManifest(size, dataset.digest, dict(sorted(done.items()))).write(directory)
                n_done += dataset.shards[index].views
                progress(n_done, total)
