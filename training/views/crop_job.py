"""Render the views of a dataset once more, for the crops that image networks are trained on.

    render_crops(meshes, ViewDataset.open("views"), size=96, pool=local_workers(2))

The dataset and its digest do not change: crops may be added to views that runs were trained on.
"""

import contextlib
import functools
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, check_output_directory, remove_leftovers
from thor2_jax.frames.frames import RGBDFrame
from training.augmentation.augmentations import Augmentations
from training.objects.mesh import TexturedMesh
from training.rendering.camera import RenderedView
from training.rendering.view_sphere import view_angles
from training.storage.jobs import check_same_job, locked
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views.crops import (
    CROP_SIZE,
    CROPS,
    MANIFEST,
    CropManifest,
    QuantizedCrop,
    ViewCrops,
    crop_file,
    encode_crops,
    intact_content,
    quantized,
    rgbd_crop,
    stacked,
)
from training.views.dataset import ViewDataset
from training.views.mesh_views import RenderProgress, ViewTask, all_views, clouds_per_view, view_tasks
from training.views.render_job import ShardPlan

__all__ = ["render_crops", "view_crop"]


class _Crop(NamedTuple):
    view: int
    copy: int
    images: QuantizedCrop


def view_crop(view: RenderedView, size: int = CROP_SIZE) -> QuantizedCrop | None:
    """Return the crop of a rendered view; None if nothing is visible."""
    labels = (view.depth > 0).astype(np.uint8)
    if not labels.any():
        return None
    return quantized(rgbd_crop(RGBDFrame(view.color, view.depth, labels, view.intrinsics), 1, size))


def _crops_of_task(task: ViewTask, size: int) -> list[_Crop]:
    crops = ((number, copy, view_crop(view, size)) for number, copy, view in all_views(task))
    return [_Crop(number, copy, images) for number, copy, images in crops if images is not None]


def _begin(directory: Path, dataset: ViewDataset, size: int) -> dict[str, str]:
    """Return the intact files of an interrupted rendering, file name -> checksum.

    Raises:
        InputError: the crops have another size, or are of another dataset.
    """
    check_output_directory(directory, MANIFEST)
    if not (directory / MANIFEST).is_file():
        return {}
    stored = CropManifest.read(directory)
    check_same_job(
        directory, {"crops": stored.size, "dataset": stored.dataset}, {"crops": size, "dataset": dataset.digest}
    )
    remove_leftovers(directory)
    return {name: sha for name, sha in stored.files.items() if intact_content(directory, name, sha) is not None}


def _of_shard(dataset: ViewDataset, index: int, rendered: Sequence[_Crop], size: int) -> ViewCrops:
    """Return the crops of the clouds of a shard, in their order."""
    views = dataset.read(index)
    by_view = {(crop.view, crop.copy): crop.images for crop in rendered}
    keys = list(zip(views.view.tolist(), views.copy.tolist(), strict=True))
    missing = [key for key in keys if key not in by_view]
    if missing:
        raise InputError(
            f"meshes: view {missing[0][0]} of {dataset.classes[views.label]!r} is in {dataset.directory}, but is empty "
            "now; give the meshes of the dataset"
        )
    return stacked([by_view[key] for key in keys], size)


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
        size: side of the crops, pixels.
        pool: worker processes that render; does not affect the result.
        progress: called with (crops done, total crops) at the start and after each shard.
        augmentations: those of the dataset.
        seed: seed of the dataset.

    Raises:
        InputError: `size` is less than 1, or the dataset has crops of another size or views of other meshes.
        OSError: a file cannot be written; the rendering can be resumed.
    """
    if size < 1:
        raise InputError(f"crops is {size}; expected at least 1 pixel")
    directory = dataset.directory / CROPS
    job = dataset.manifest.job
    angles = view_angles(job["azimuth_step"], job["polar_step"])
    plan = ShardPlan(angles, clouds_per_view(augmentations), dataset.classes)
    with locked(directory):
        done = _begin(directory, dataset, size)
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
                content = encode_crops(_of_shard(dataset, index, rendered, size))
                with atomic_write(directory / name) as temporary:
                    temporary.write_bytes(content)
                done[name] = hashlib.sha256(content).hexdigest()
                CropManifest(size, dataset.digest, done).write(directory)
                n_done += dataset.shards[index].views
                progress(n_done, total)
