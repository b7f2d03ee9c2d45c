"""Sample views of objects from random cameras, with stronger augmentation than for classifiers.

    samples = build_samples(range(400), "samples", network, config, views=16, pool=local_workers(2))

An embedding is used on cameras and objects that it never saw; a classifier is fitted on its own objects. Shards on disk
hold the samples of some objects each, so that an interrupted sampling resumes at the first missing shard.

Samples of distractors are kept in the user's cache: all runs use the same ones, and rendering them takes minutes. Each
file holds the samples of one record of everything that determines them, and is named by the record's digest.
"""

import contextlib
import dataclasses
import json
import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import jax
import numpy as np
import safetensors.numpy

import thor2_jax
import training
from colornet import ColorNetwork
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.descriptor.cloud_statistics import N_BALANCED
from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, content_digest, json_digest, remove_leftovers, safetensors_metadata
from thor2_jax.types import Cloud
from training.augmentation.augmentations import KINDS, Augmentations, augment
from training.embedding.samples import Samples, joined_samples, sample_clouds
from training.objects.meshes import load_mesh
from training.objects.procedural import procedural_object
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import Camera, camera_pose, random_angles
from training.storage.jobs import begin_job, cache_directory, locked, processor
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views.mesh_views import MIN_VIEW_POINTS, cloud_of

__all__ = [
    "AUGMENTATIONS",
    "ObjectSource",
    "ViewTask",
    "build_samples",
    "cached_samples",
    "render_clouds",
    "sampling_job",
]

OBJECTS_PER_SHARD = 32

AUGMENTATIONS = Augmentations.of_names(KINDS)

UNCHANGED = 0.2
"""Share of views without augmentation."""

CAMERA = Camera.from_field_of_view(540, 405, 40.0)
"""Half the pixels of the training camera: still two for each voxel of a cloud."""

ObjectSource = int | Path
"""The seed of a procedural object, or a mesh file."""


@dataclasses.dataclass(frozen=True)
class ViewTask:
    """Views of some objects, to be rendered by one process.

    Attributes:
        sources: index -> object.
        views: number of views of each object.
        seed: seed for cameras and augmentations, with the index.
    """

    sources: Mapping[int, ObjectSource]
    views: int
    seed: int


def render_clouds(task: ViewTask) -> list[tuple[int, Cloud]]:
    """Return the object's index and the cloud of the views that have at least `MIN_VIEW_POINTS` points.

    Raises:
        InputError: a mesh is unreadable.
    """
    clouds = []
    for index, source in task.sources.items():
        mesh = load_mesh(source) if isinstance(source, Path) else procedural_object(source)
        caster = RayCaster([mesh])
        rng = np.random.default_rng([task.seed, index])
        for _ in range(task.views):
            view = render_view(caster, camera_pose(*random_angles(rng), mesh.centre), CAMERA)
            cloud = cloud_of(view if rng.random() < UNCHANGED else augment(view, AUGMENTATIONS, rng))
            if len(cloud[0]) >= MIN_VIEW_POINTS:
                clouds.append((index, cloud))
    return clouds


def sampling_job(
    objects: Sequence[int | str], network: ColorNetwork, config: DescriptorConfig, views: int, copies: int, seed: int
) -> dict[str, Any]:
    """Return the record of a sampling; `objects` says what they are, see `build_samples` for the others."""
    return {
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(config),
        "color_network": network.fingerprint,
        "balanced_bins": N_BALANCED,
        "objects": list(objects),
        "views": views,
        "copies": copies,
        "seed": seed,
        "augmentations": AUGMENTATIONS.record(),
    }


def build_samples(
    sources: Sequence[ObjectSource],
    directory: str | Path,
    network: ColorNetwork,
    config: DescriptorConfig,
    views: int,
    copies: int = 2,
    seed: int = 0,
    pool: WorkerPool = IN_PROCESS,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Samples:
    """Render views of objects and sample them, or resume an interrupted sampling in a directory.

    Args:
        sources: objects; labels are indices into this sequence. An object that occurs n times has n times the views
            and the label of its first occurrence.
        directory: new, or of the same arguments.
        network: colour network.
        config: descriptor. Static.
        views: number of views of each object.
        copies: samples of each view, in random orientations.
        seed: seed for cameras, augmentations and orientations.
        pool: worker processes that render; does not affect the result.
        progress: called with (objects done, number of objects) at the start and after each shard.

    Raises:
        InputError: there are fewer than two objects or no views, a mesh is unreadable or is visible in none of its
            views, or the directory holds samples of other arguments or is written by another process.
        OSError: the directory cannot be written.
    """
    if len(sources) < 2 or views < 1:
        raise InputError(f"there are {len(sources)} objects with {views} views each; expected at least 2 with 1 view")
    directory = Path(directory)
    numbered = list(enumerate(sources))
    label_of = {source: index for index, source in reversed(numbered)}
    job = sampling_job([str(source) for source in sources], network, config, views, copies, seed)
    with locked(directory):
        begin_job(directory, job)
        starts = range(0, len(sources), OBJECTS_PER_SHARD)
        files = {first: directory / f"{first:05d}.safetensors" for first in starts}
        missing = [first for first in starts if not files[first].is_file()]
        progress(min((len(starts) - len(missing)) * OBJECTS_PER_SHARD, len(sources)), len(sources))
        tasks = (ViewTask(dict(numbered[first : first + OBJECTS_PER_SHARD]), views, seed) for first in missing)
        with closing(pool(render_clouds, tasks)) as results:
            for first, rendered in zip(missing, results, strict=True):
                visible = {index for index, _ in rendered}
                for index in range(first, min(first + OBJECTS_PER_SHARD, len(sources))):
                    if index not in visible:
                        raise InputError(f"object {sources[index]} has no view with enough points; leave it out")
                rng = np.random.default_rng([seed, len(sources), first])
                labels, clouds = [label_of[sources[index]] for index, _ in rendered], [cloud for _, cloud in rendered]
                with atomic_write(files[first]) as temporary:
                    arrays = sample_clouds(clouds, labels, network, config, copies, rng)
                    temporary.write_bytes(safetensors.numpy.save(arrays))
                progress(min(first + OBJECTS_PER_SHARD, len(sources)), len(sources))
        return joined_samples([safetensors.numpy.load_file(file) for file in files.values()], config)


MAX_FILES = 3
"""Number of files that are kept; the ones that were used last."""

FORMAT = "thor2 samples of distractors, 1"
NAME = re.compile(r"distractors-[0-9a-f]{64}\.safetensors")

CODE = ("augmentation", "embedding", "objects", "rendering", "views")
LIBRARY_CODE = (".", "descriptor", "frames")
"""Packages of training and of the library whose code determines the samples."""

log = logging.getLogger(__name__)


def cached_samples(job: Mapping[str, Any], build: Callable[[], Samples], resumes: bool = False) -> Samples:
    """Return samples from the cache, or build them and store them there.

    A cache that cannot be used costs the time to build the samples, and is logged as a warning.

    Args:
        job: record of everything that determines the samples beside the software and the kind of processor.
        build: returns the samples.
        resumes: whether `build` resumes an interrupted sampling, which is then not replaced by samples of the cache.

    Raises:
        InputError: THOR2_CACHE names a file; or as `build`.
        OSError: as `build`.
    """
    directory = cache_directory("distractors")
    if directory is None:
        return build()
    file = directory / f"distractors-{json_digest({**job, **_software()})}.safetensors"
    try:
        if not resumes and file.is_file():
            samples = _read(file)
            with contextlib.suppress(OSError):  # a read-only cache is used as it is
                os.utime(file)
            return samples
    except (OSError, ValueError, KeyError, TypeError, AttributeError, safetensors.SafetensorError) as error:
        advice = "" if _is_own(file) else "; delete this file"
        log.warning("%s cannot be used (%s); the distractors are rendered again%s", file, error, advice)
    samples = build()
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        with locked(directory):
            remove_leftovers(directory)
            if not file.exists() or _is_own(file):
                _write(file, samples)
            own = [path for path in directory.iterdir() if _is_own(path)]
            for path in sorted(own, key=lambda path: path.stat().st_mtime, reverse=True)[MAX_FILES:]:
                path.unlink(missing_ok=True)
    except InputError:
        pass  # another process is writing, usually the same file
    except OSError as error:
        log.warning("the distractors cannot be kept for the next training: %s", error)
    return samples


def _software() -> dict[str, str]:
    """Return the record of the software: users of a checkout change code within a version."""
    root = Path(training.__file__).parent
    folders = [root / package for package in CODE] + [Path(thor2_jax.__file__).parent / each for each in LIBRARY_CODE]
    files = (file for folder in folders for file in sorted(folder.glob("*.py")))
    return {
        "version": thor2_jax.__version__,
        "code": content_digest(file.read_bytes() for file in files),
        "platform": f"{jax.default_backend()} {processor()}",
    }


def _content(arrays: Mapping[str, Any]) -> str:
    return content_digest(part for name in sorted(arrays) for part in (name, arrays[name].tobytes()))


def _write(file: Path, samples: Samples) -> None:
    arrays = {name: value for name, value in vars(samples).items() if name != "shape"}
    metadata = {"format": FORMAT, "shape": json.dumps(samples.shape), "sha256": _content(arrays)}
    with atomic_write(file) as temporary:
        temporary.write_bytes(safetensors.numpy.save(arrays, metadata))


def _read(file: Path) -> Samples:
    """Read samples; raises ValueError, KeyError, TypeError or SafetensorError if the file is damaged."""
    metadata = _metadata(file)
    if metadata["format"] != FORMAT:
        raise ValueError(f"its format is {metadata['format']!r}; expected {FORMAT!r}")
    arrays = safetensors.numpy.load(file.read_bytes())
    if metadata["sha256"] != _content(arrays):
        raise ValueError("its content is damaged")
    return Samples(shape=tuple(json.loads(metadata["shape"])), **arrays)


def _metadata(file: Path) -> dict[str, str]:
    """Return the metadata of a file that may be damaged behind its header."""
    with file.open("rb") as stream:
        return safetensors_metadata(stream.read(2**16))


def _is_own(path: Path) -> bool:
    """Return whether a file is one of the cache, by name and content, and may be replaced or removed."""
    try:
        is_file = NAME.fullmatch(path.name) is not None and path.is_file() and not path.is_symlink()
        return is_file and _metadata(path)["format"].startswith(FORMAT.split(",")[0])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False
