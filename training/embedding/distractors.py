"""Distractors: objects outside the classes of a run, the samples of their views, and the user's cache of these samples.

    samples = sample_objects(range(400), network, config, views=16, pool=local_workers(2), directory=Path("chunks"))

Views of objects are rendered from random cameras. Their augmentation is stronger than for classifiers, since an
embedding is used for new objects, while a classifier is fitted on its own objects.

Distractors are procedural objects, or meshes of other objects. An embedding is fitted on them, too, so that it rejects
unknown objects. A tenth of them is held out, to calibrate the confidence on unknown objects that no network has seen.

Their samples are stored in the user's cache, since all runs use the same samples and rendering takes minutes. A
directory holds the samples for one record of everything that determines them, and its name contains the digest of the
record.
"""

import contextlib
import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import thor2_jax
import training
from colornet import ColorNetwork
from thor2_jax import DESCRIPTOR_VERSION, DescriptorConfig, InputError, view_normalize
from thor2_jax.files import content_digest, json_digest, remove_written
from thor2_jax.types import Cloud
from training.augmentation.augmentations import KINDS, Augmentations, augment
from training.fitting.samples import OF_EMBEDDING, Samples, sample_normalized
from training.objects.mesh import TexturedMesh
from training.objects.meshes import load_mesh
from training.objects.procedural import procedural_object
from training.rendering.camera import Camera, RayCaster, camera_pose, random_angles
from training.storage.jobs import cache_directory, load_arrays, processor, save_arrays
from training.storage.workers import IN_PROCESS, WorkerPool, local_workers
from training.views.mesh_views import MIN_VIEW_POINTS, cloud_of
from training.views.normalized_views import padded_batches

__all__ = ["AUGMENTATIONS", "Distractors", "sample_objects", "samples_record"]

OBJECTS_PER_TASK = 32

SEED = 0
"""Seed of the views of objects and of their orientations: all runs share the distractors in the user's cache."""

AUGMENTATIONS = Augmentations.of_names(KINDS)

UNCHANGED = 0.2
"""Fraction of the views without augmentation."""

CAMERA = Camera.from_field_of_view(540, 405, 40.0)
"""Camera with half the pixels of the training camera, which is still two pixels per voxel of a cloud."""

ObjectSource = int | Path | TexturedMesh
"""The seed of a procedural object, a mesh file, or a mesh."""


def render_clouds(objects: Mapping[int, ObjectSource], views: int) -> list[tuple[int, Cloud]]:
    """Return the object's index and the cloud of each view with at least `MIN_VIEW_POINTS` points.

    Args:
        objects: index -> object.
        views: number of views of each object.

    Raises:
        InputError: a mesh is unreadable.
    """
    clouds = []
    for index, source in objects.items():
        mesh = procedural_object(source) if isinstance(source, int) else load_mesh(source)
        caster = RayCaster([mesh])
        rng = np.random.default_rng([SEED, index])
        for _ in range(views):
            view = caster.render(camera_pose(*random_angles(rng), mesh.centre), CAMERA)
            cloud = cloud_of(view if rng.random() < UNCHANGED else augment(view, AUGMENTATIONS, rng))
            if len(cloud[0]) >= MIN_VIEW_POINTS:
                clouds.append((index, cloud))
    return clouds


CODE = ("augmentation", "embedding", "fitting", "objects", "rendering", "views")
"""Packages of training whose code determines the samples."""

LIBRARY_CODE = (".", "descriptor", "frames")
"""Packages of the library whose code determines the samples."""


def samples_record(
    sources: Sequence[ObjectSource], network: ColorNetwork, config: DescriptorConfig, views: int
) -> dict[str, Any]:
    """Return everything that determines the result of `sample_objects` with these arguments, in JSON types.

    This includes a digest of the code, since code may change within a version in a checkout.
    """
    root = Path(training.__file__).parent
    folders = [root / package for package in CODE] + [Path(thor2_jax.__file__).parent / each for each in LIBRARY_CODE]
    files = (file for folder in folders for file in sorted(folder.glob("*.py")))
    return {
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(config),
        "color_network": network.fingerprint,
        "objects": [each if isinstance(each, int) else load_mesh(each).digest for each in sources],
        "views": views,
        "copies": OF_EMBEDDING.orientations,
        "seed": SEED,
        "augmentations": AUGMENTATIONS.record(),
        "version": thor2_jax.__version__,
        "code": content_digest(file.read_bytes() for file in files),
        "platform": f"{jax.default_backend()} {processor()}",
    }


def sample_objects(
    sources: Sequence[ObjectSource],
    network: ColorNetwork,
    config: DescriptorConfig,
    views: int,
    pool: WorkerPool = IN_PROCESS,
    progress: Callable[[int, int], object] = lambda done, total: None,
    *,
    directory: Path,
) -> Samples:
    """Render views of objects and sample them.

    Args:
        sources: objects; labels are indices into this sequence.
        network: colour network.
        config: descriptor. Static.
        views: number of views of each object.
        pool: worker processes that render; they do not affect the result.
        progress: called with (objects done, number of objects) at the start and after each task of a worker.
        directory: directory for these samples only, created if it is missing. The samples of each task are stored
            there, so that an interrupted call resumes.

    Raises:
        InputError: a mesh is unreadable or is visible in none of its views.
        OSError: the directory cannot be written.
    """
    numbered = list(enumerate(sources))
    tasks = {
        directory / f"{first:06d}.safetensors": dict(numbered[first : first + OBJECTS_PER_TASK])
        for first in range(0, len(sources), OBJECTS_PER_TASK)
    }
    directory.mkdir(parents=True, exist_ok=True)
    chunks: dict[Path, Samples] = {}
    for file in tasks:
        with contextlib.suppress(OSError, ValueError, KeyError):  # the file is missing or damaged
            chunks[file] = Samples.of_arrays(load_arrays(file))
    missing = {file: task for file, task in tasks.items() if file not in chunks}
    done = sum(len(tasks[file]) for file in chunks)
    progress(done, len(sources))
    render = functools.partial(render_clouds, views=views)
    with contextlib.closing(pool(render, missing.values())) as results:
        for (file, task), rendered in zip(missing.items(), results, strict=True):
            if invisible := task.keys() - {index for index, _ in rendered}:
                raise InputError(f"object {sources[min(invisible)]} has no view with enough points; leave it out")
            rng = np.random.default_rng([SEED, len(sources), min(task)])
            rendered = sorted(rendered, key=lambda view: len(view[1][0]))  # for batches with little padding
            label = np.array([index for index, _ in rendered], np.int32)
            batches = padded_batches([cloud for _, cloud in rendered])
            normal = ((count, view_normalize(clouds, config)) for count, clouds in batches)
            view = np.zeros_like(label)
            chunks[file] = sample_normalized(normal, label, view, network, config, rng, OF_EMBEDDING)
            save_arrays(file, chunks[file].arrays(), {})
            done += len(task)
            progress(done, len(sources))
    return Samples.concatenated([chunks[file] for file in tasks])


ONE_HELD_OUT_OF = 10
"""One in this many distractors is held out."""


@dataclasses.dataclass(frozen=True)
class Distractors:
    """Distractors, and the settings for fitting the embedding on distractors and classes.

    Attributes:
        procedural: number of procedural objects.
        meshes: name -> other object.
        views: views of each distractor.
        epochs: passes over the samples.
        networks: number of networks in the embedding; docs/decisions.md explains why there are several.
        workers: rendering processes; they do not affect the result.

    Raises:
        InputError: there are fewer than ten distractors.
    """

    procedural: int = 1500
    meshes: Mapping[str, Path | TexturedMesh] = dataclasses.field(default_factory=dict)
    views: int = 8
    epochs: int = 8
    networks: int = 3
    workers: int = 1

    def __post_init__(self) -> None:
        if (count := self.procedural + len(self.meshes)) < ONE_HELD_OUT_OF:
            few = f"there are {count} objects as distractors, {self.procedural} of them procedural"
            raise InputError(f"embedding: {few}; expected at least {ONE_HELD_OUT_OF}; give more")

    @property
    def sources(self) -> list[ObjectSource]:
        """The meshes and the procedural objects in a fixed random order, so that both kinds are held out."""
        mixed: list[ObjectSource] = [*self.meshes.values(), *range(self.procedural)]
        return [mixed[k] for k in np.random.default_rng(0).permutation(len(mixed))]

    def check(self, classes: Sequence[str]) -> None:
        """Raise InputError if a mesh is unreadable, or a distractor has the name of a class."""
        if shared := sorted(set(self.meshes) & set(classes)):
            raise InputError(
                f"distractors: {shared[0]!r} is also a class; expected other objects; remove its mesh from one of the "
                "two folders"
            )
        _ = self.record

    @functools.cached_property
    def record(self) -> dict[str, Any]:
        """Everything about the distractors that determines the embedding, in JSON types; reads the meshes."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "workers"}
        return named | {"meshes": [[name, load_mesh(path).digest] for name, path in sorted(self.meshes.items())]}

    def samples(
        self, directory: Path, network: ColorNetwork, config: DescriptorConfig, progress: Callable[[int, int], object]
    ) -> Samples:
        """Return the samples of all distractors; render those that are not in the user's cache.

        A warning is logged if the cache cannot be used.

        Args:
            directory: directory of the training, which takes the place of a cache that is disabled or cannot be used.
            network: colour network.
            config: descriptor. Static.
            progress: called with (distractors done, number of distractors).

        Returns:
            The samples; labels are indices into `sources`.

        Raises:
            InputError: a mesh is unreadable or visible in none of its views.
            OSError: the directory cannot be written.
        """
        arguments = self.sources, network, config, self.views
        sample = functools.partial(sample_objects, *arguments, local_workers(self.workers), progress)
        name = f"distractors-{json_digest(samples_record(*arguments))}"
        if (cache := cache_directory("distractors")) is not None:
            try:
                cache.mkdir(mode=0o700, parents=True, exist_ok=True)
                samples = sample(directory=cache / name)
                _keep_newest(cache, name)
                return samples
            except ChildProcessError:
                raise
            except OSError as error:
                log.warning("the distractors cannot be stored for the next training: %s", error)
        return sample(directory=directory / name)

    def held_out_clouds(self, first: int) -> list[tuple[int, Cloud]]:
        """Return the label (from `first` on) and the cloud (in metres) of each view of the held-out distractors.

        The views are rendered again, since samples are strips in random orientations, and the looks need the points.
        """
        objects = dict(list(enumerate(self.sources))[::ONE_HELD_OUT_OF])
        return [(first + index, cloud) for index, cloud in render_clouds(objects, self.views)]

    @staticmethod
    def add_fitted(samples: Samples, distractors: Samples, n_classes: int) -> Samples:
        """Return the samples of the classes, followed by the samples of the distractors that are not held out.

        The labels of the distractors follow the labels of the classes without gaps.
        """
        fitted = distractors.select(np.flatnonzero(distractors.label % ONE_HELD_OUT_OF))
        label = n_classes + fitted.label - fitted.label // ONE_HELD_OUT_OF - 1
        return Samples.concatenated([samples, dataclasses.replace(fitted, label=label.astype(np.int32))])


MAX_STORED = 3
"""Number of directories of samples that are kept in the cache: those used most recently."""

log = logging.getLogger(__name__)


def _keep_newest(cache: Path, used: str) -> None:
    """Remove the samples in a cache that have not been used for the longest time."""
    with contextlib.suppress(OSError):  # the cache may be read-only
        os.utime(cache / used)
        stored = cache.glob("distractors-" + 64 * "[0-9a-f]")
        for path in sorted(stored, key=lambda path: path.stat().st_mtime, reverse=True)[MAX_STORED:]:
            remove_written(path, r"[0-9]{6}\.safetensors")
