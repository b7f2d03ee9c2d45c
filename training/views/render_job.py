"""The rendering job: meshes to a folder of normalized views that `ViewDataset` reads.

    dataset = render_dataset(find_meshes("meshes"), "views", pool=local_workers(2))

Workers render; this process normalizes and writes, a shard at a time, in the order of the job. So the bytes depend
neither on the number of workers nor on where they are, and a job that was interrupted goes on where it was.
"""

import contextlib
import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.errors import InputError, with_context
from thor2_jax.files import atomic_write, check_output_directory, content_digest
from thor2_jax.recognition.prepared_instance import DESCRIPTOR_VOXEL
from training.augmentation.augmentations import Augmentations
from training.objects.mesh import TexturedMesh
from training.rendering.camera import TRAINING_CAMERA
from training.rendering.view_sphere import DISTANCE, view_angles
from training.storage.jobs import check_same_job
from training.storage.locks import locked
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views.dataset import MANIFEST, Manifest, Shard, ViewDataset, encode
from training.views.mesh_views import (
    MIN_POINTS,
    SIGMA_S,
    Progress,
    ViewCloud,
    checked_meshes,
    clouds_per_view,
    render_task,
    view_tasks,
)
from training.views.normalized_views import COORDINATE_STEP, MAX_COORDINATE, normalize_views

__all__ = ["render_dataset"]

CLOUDS_PER_SHARD = 256
"""Clouds of a shard, some less where copies do not come out even: a few megabytes, a second of rendering."""

SUFFIX = ".safetensors"


def _digest(mesh: TexturedMesh) -> str:
    """SHA-256 of all that is rendered: files can name others, and objects need not come from files."""
    parts: list[str | bytes] = []
    for array in (mesh.vertices, mesh.faces, mesh.uv, mesh.face_texture, mesh.corner_colors, *mesh.textures):
        parts += ["False"] if array is None else [repr((array.dtype.str, array.shape)), array.tobytes()]
    return content_digest(parts)


def _objects(found: Mapping[str, Path | TexturedMesh], angles: NDArray[np.float64]) -> list[dict[str, str]]:
    objects = []
    for name, mesh in checked_meshes(found, angles):
        across = SIGMA_S * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        if across > MAX_COORDINATE:
            raise InputError(
                f"object {name!r} has a diameter of {across / SIGMA_S:.2f} m; at most {MAX_COORDINATE / SIGMA_S:.2f} m "
                "can be stored; scale the mesh to metres"
            )
        objects.append({"name": name, "mesh": _digest(mesh)})
    return objects


def _leftovers(folder: Path) -> set[Path]:
    """Files that a process was writing when it was killed."""
    return {path for pattern in (f".{Path(MANIFEST).stem}.*", f".*{SUFFIX}") for path in folder.glob(pattern)}


def _is_whole(shard: Shard, folder: Path) -> bool:
    try:
        shard.content(folder)
    except InputError:
        return False
    return True


def _begin(folder: Path, job: Mapping[str, Any]) -> Manifest:
    """The folder's manifest, made if there is none, with those shards only whose files are whole.

    Raises:
        InputError: the folder holds another job.
        OSError: it cannot be written.
    """
    path = folder / MANIFEST
    found = Manifest.parse(path.read_bytes(), path) if path.exists() else None
    if found:
        check_same_job(folder, found.job, job)
    for leftover in _leftovers(folder):
        leftover.unlink()
    manifest = Manifest(job, tuple(shard for shard in found.shards if _is_whole(shard, folder)) if found else ())
    if manifest != found:
        manifest.write(folder)
    return manifest


def _store(path: Path, label: int, planned: int, rendered: Sequence[ViewCloud]) -> Shard:
    """Normalize the views of a shard and write its file; `planned` is their number with those left out.

    Raises:
        InputError: a view that cannot be normalized or stored.
        OSError: the file cannot be written.
    """
    views = normalize_views(
        [(cloud.xyz, cloud.rgb) for cloud in rendered],
        label,
        [cloud.view for cloud in rendered],
        [cloud.copy for cloud in rendered],
        DescriptorConfig(),
    )
    content = encode(views)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)
    return Shard(
        file=path.name,
        sha256=hashlib.sha256(content).hexdigest(),
        label=label,
        views=len(views),
        left_out=planned - len(views),
        points=len(views.xyz),
    )


def render_dataset(
    found: Mapping[str, Path | TexturedMesh],
    out: str | Path,
    azimuth_step: float = 5.0,
    polar_step: float = 5.0,
    pool: WorkerPool = IN_PROCESS,
    progress: Progress = lambda done, total: None,
    augmentations: Augmentations | None = None,
    seed: int = 0,
) -> ViewDataset:
    """Render views of every object, normalize them and write them to a folder, or finish what the folder holds of that.

    Called again with the same arguments after any interruption, it makes what is missing or damaged, and the folder
    ends up with the bytes that it would have had without. Memory holds a shard a worker, and one.

    Args:
        found: object name -> mesh file, as from `find_meshes`, or mesh.
        out: folder; new, empty, or with a dataset of the same arguments. Made with its parents.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.
        pool: where views are rendered; has no influence on the result.
        progress: called with (views done, views in all) at the start and after each shard; copies count as views.
        augmentations: adds varied copies of each view; None adds none.
        seed: of the augmentations. What an object's copies look like does not depend on the other objects.

    Raises:
        InputError: no meshes, a mesh that cannot be read, is too large or never seen, steps or a seed that do not fit,
            `out` holds something else or views of other arguments (says what differs), or another process is writing to
            it. Nothing is written then.
        OSError: `out` cannot be written. It can be finished later.
    """
    out = Path(out)
    check_output_directory(out, MANIFEST)
    if seed < 0:
        raise InputError(f"seed is {seed}; it must not be negative")
    angles = view_angles(azimuth_step, polar_step)
    objects = _objects(found, angles)
    copies = clouds_per_view(augmentations)
    size = max(1, CLOUDS_PER_SHARD // copies)
    # Shard's file -> object's index and index of the first of the shard's angles.
    plan = {
        f"{label:04d}-{number:04d}{SUFFIX}": (label, first)
        for label in range(len(objects))
        for number, first in enumerate(range(0, len(angles), size))
    }
    job = {
        "descriptor_version": DESCRIPTOR_VERSION,
        "sigma_s": SIGMA_S,
        "voxel": DESCRIPTOR_VOXEL,
        "step": COORDINATE_STEP,
        "min_points": MIN_POINTS,
        "camera": {**dataclasses.asdict(TRAINING_CAMERA), "distance": DISTANCE},
        "azimuth_step": float(azimuth_step),
        "polar_step": float(polar_step),
        "variations": {"seed": seed, **augmentations.record()} if augmentations else None,
        "objects": objects,
        "shards": len(plan),
    }
    done: dict[str, Shard] = {}

    def show_progress() -> None:
        progress(sum(shard.views + shard.left_out for shard in done.values()), copies * len(angles) * len(objects))

    with locked(out):
        done.update((shard.file, shard) for shard in _begin(out, job).shards)
        show_progress()
        missing = [file for file in plan if file not in done]
        parts = [(objects[label]["name"], first) for label, first in (plan[file] for file in missing)]
        tasks = view_tasks(found, angles, parts, size, augmentations, seed)
        with contextlib.closing(pool(render_task, tasks)) as results:
            for file, rendered in zip(missing, results, strict=True):
                label, first = plan[file]
                with with_context(f"object {objects[label]['name']!r}"):
                    done[file] = _store(out / file, label, copies * len(angles[first : first + size]), rendered)
                Manifest(job, tuple(done[name] for name in plan if name in done)).write(out)
                show_progress()
    return ViewDataset.open(out)
