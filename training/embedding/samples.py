"""Samples for fitting an embedding: the strips of clouds in random orientations.

    samples = build_samples(range(400), network, config, views=16, pool=local_workers(2), directory=Path("chunks"))

A sample stores only its occupied strips, about a tenth of all strips, and the statistics of its cloud.

Views of objects are rendered from random cameras. Their augmentation is stronger than for classifiers, since an
embedding is used for new objects, while a classifier is fitted on its own objects.
"""

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

import thor2_jax
import training
from colornet import ColorNetwork
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import balanced_histogram, cloud_statistics
from thor2_jax.descriptor.view_normalization import turn, view_normalize
from thor2_jax.errors import InputError
from thor2_jax.files import content_digest
from thor2_jax.types import Cloud
from training.augmentation.augmentations import KINDS, Augmentations, augment
from training.objects.meshes import load_mesh
from training.objects.procedural import procedural_object
from training.rendering.camera import Camera, RayCaster, camera_pose, random_angles, render_view
from training.storage.jobs import load_arrays, processor, save_arrays
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views.mesh_views import MIN_VIEW_POINTS, cloud_of
from training.views.normalized_views import ViewSource, padded_batches, reorient

__all__ = [
    "AUGMENTATIONS",
    "Batch",
    "ObjectSource",
    "Samples",
    "build_samples",
    "render_clouds",
    "sample_clouds",
    "sample_views",
    "samples_record",
]

COPIES = 2
"""Samples of each cloud, in random orientations."""


class Batch(NamedTuple):
    """B samples as host arrays; the descriptors are computed from the strips.

    Attributes:
        length: [B, S, J] float16, largest minus smallest y of each strip, scaled units; 0 for an empty strip.
        color: [B, S, J, R] float16, colour vectors of the strips.
        statistics: [B, 12 + R + N_BALANCED] float32, from `cloud_statistics` and `balanced_histogram`.
        label: [B] int32.
    """

    length: Any
    color: Any
    statistics: Any
    label: Any


@dataclasses.dataclass(frozen=True)
class Samples:
    """Samples in compact form, one after the other.

    Attributes:
        strips: [M] int64, number of strips of each sample.
        strip: [T] uint16, slice x J + strip.
        length: [T] float16.
        color: [T, R] float16.
        statistics: [M, 12 + R + N_BALANCED] float32.
        label: [M] int32.
    """

    strips: NDArray[np.int64]
    strip: NDArray[np.uint16]
    length: NDArray[np.float16]
    color: NDArray[np.float16]
    statistics: NDArray[np.float32]
    label: NDArray[np.int32]

    @classmethod
    def concatenated(cls, chunks: Sequence["Samples"]) -> "Samples":
        """Return the samples of all chunks, of which there must be at least one."""
        return cls(**{name: np.concatenate([chunk.arrays()[name] for chunk in chunks]) for name in chunks[0].arrays()})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return field name -> array."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    def __len__(self) -> int:
        return len(self.label)

    @functools.cached_property
    def _ends(self) -> NDArray[np.int64]:
        return np.cumsum(self.strips)

    def select(self, rows: NDArray[np.integer[Any]]) -> "Samples":
        """Return the samples with the given indices."""
        strips = self.strips[rows]
        entry = np.arange(strips.sum()) + np.repeat(self._ends[rows] - np.cumsum(strips), strips)
        of_strips = self.strip[entry], self.length[entry], self.color[entry]
        return Samples(strips, *of_strips, self.statistics[rows], self.label[rows])

    def take(self, rows: NDArray[np.integer[Any]], config: DescriptorConfig) -> Batch:
        """Return the samples with the given indices as a batch; `config` is the descriptor of the samples."""
        chosen, grid = self.select(rows), (len(rows), config.n_slices, config.n_strips)
        at = np.repeat(np.arange(len(rows)), chosen.strips), *np.divmod(chosen.strip, config.n_strips)
        length, color = np.zeros(grid, np.float16), np.zeros((*grid, self.color.shape[1]), np.float16)
        length[at], color[at] = chosen.length, chosen.color
        return Batch(length, color, chosen.statistics, chosen.label)

    def batches(self, rows: NDArray[np.integer[Any]], size: int, config: DescriptorConfig) -> Iterator[Batch]:
        """Yield the samples with the given indices in batches of one size; the last one is filled with the first."""
        for chunk in np.resize(rows, -(-len(rows) // size) * size).reshape(-1, size):
            yield self.take(chunk, config)


def sample_clouds(
    clouds: Sequence[Cloud],
    labels: Sequence[int],
    network: ColorNetwork,
    config: DescriptorConfig,
    rng: np.random.Generator,
    are_normal: bool = False,
) -> Samples:
    """Return samples of clouds, each in `COPIES` random orientations.

    Args:
        clouds: at least one; xyz [n, 3] float32 metres in the camera frame, or normalized; rgb [n, 3] uint8.
        labels: label of each cloud.
        network: colour network.
        config: descriptor. Static.
        rng: generator of the orientations.
        are_normal: whether the clouds are normalized. They stay in their order; clouds of one size share a batch
            otherwise, so that little of it is padding.
    """
    order = range(len(clouds)) if are_normal else sorted(range(len(clouds)), key=lambda k: len(clouds[k][0]))
    label = np.array([labels[k] for k in order], np.int32)
    chunks: list[Samples] = []
    done = 0
    for count, batch in padded_batches([clouds[k] for k in order]):
        normal = batch if are_normal else view_normalize(batch, config)
        sides = jnp.max(normal.points, axis=1)
        balanced = balanced_histogram(normal.colors, normal.mask)
        for _ in range(COPIES):
            occupied = strips(turn(reorient(normal, rng), config), network, config)
            statistics = np.hstack([cloud_statistics(sides, normal, occupied), balanced])[:count]
            sample, strip = np.nonzero(np.asarray(occupied.occupied)[:count].reshape(count, -1))
            length = np.asarray(occupied.high - occupied.low).reshape(len(occupied.high), -1)
            color = np.asarray(occupied.color).reshape(*length.shape, -1)
            at, named = (sample, strip), label[done : done + count]
            of_strips = strip.astype(np.uint16), length[at].astype(np.float16), color[at].astype(np.float16)
            chunks.append(Samples(np.bincount(sample, minlength=count), *of_strips, statistics, named))
        done += count
    return Samples.concatenated(chunks)


OBJECTS_PER_TASK = 32

SEED = 0
"""Seed of the views of objects and of their orientations: all runs share the distractors in the user's cache."""

AUGMENTATIONS = Augmentations.of_names(KINDS)

UNCHANGED = 0.2
"""Fraction of the views without augmentation."""

CAMERA = Camera.from_field_of_view(540, 405, 40.0)
"""Camera with half the pixels of the training camera, which is still two pixels per voxel of a cloud."""

ObjectSource = int | Path
"""The seed of a procedural object, or a mesh file."""


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
        mesh = load_mesh(source) if isinstance(source, Path) else procedural_object(source)
        caster = RayCaster([mesh])
        rng = np.random.default_rng([SEED, index])
        for _ in range(views):
            view = render_view(caster, camera_pose(*random_angles(rng), mesh.centre), CAMERA)
            cloud = cloud_of(view if rng.random() < UNCHANGED else augment(view, AUGMENTATIONS, rng))
            if len(cloud[0]) >= MIN_VIEW_POINTS:
                clouds.append((index, cloud))
    return clouds


CODE = ("augmentation", "embedding", "objects", "rendering", "views")
"""Packages of training whose code determines the samples."""

LIBRARY_CODE = (".", "descriptor", "frames")
"""Packages of the library whose code determines the samples."""


def samples_record(
    sources: Sequence[ObjectSource], network: ColorNetwork, config: DescriptorConfig, views: int
) -> dict[str, Any]:
    """Return everything that determines the result of `build_samples` with these arguments, in JSON types.

    This includes a digest of the code, since code may change within a version in a checkout.
    """
    digests = {each: load_mesh(each).digest if isinstance(each, Path) else each for each in dict.fromkeys(sources)}
    root = Path(training.__file__).parent
    folders = [root / package for package in CODE] + [Path(thor2_jax.__file__).parent / each for each in LIBRARY_CODE]
    files = (file for folder in folders for file in sorted(folder.glob("*.py")))
    return {
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(config),
        "color_network": network.fingerprint,
        "objects": [digests[each] for each in sources],
        "views": views,
        "copies": COPIES,
        "seed": SEED,
        "augmentations": AUGMENTATIONS.record(),
        "version": thor2_jax.__version__,
        "code": content_digest(file.read_bytes() for file in files),
        "platform": f"{jax.default_backend()} {processor()}",
    }


def build_samples(
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
        sources: objects; labels are indices into this sequence. An object that occurs n times gets n times as many
            views, all with the label of its first occurrence.
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
    label_of = {source: index for index, source in reversed(numbered)}
    tasks = {
        directory / f"{first:06d}.safetensors": dict(numbered[first : first + OBJECTS_PER_TASK])
        for first in range(0, len(sources), OBJECTS_PER_TASK)
    }
    directory.mkdir(parents=True, exist_ok=True)
    chunks: dict[Path, Samples] = {}
    for file in tasks:
        with contextlib.suppress(ValueError, TypeError):  # the file is missing or damaged
            chunks[file] = Samples(**load_arrays(file))
    missing = {file: task for file, task in tasks.items() if file not in chunks}
    done = sum(len(tasks[file]) for file in chunks)
    progress(done, len(sources))
    render = functools.partial(render_clouds, views=views)
    with contextlib.closing(pool(render, missing.values())) as results:
        for (file, task), rendered in zip(missing.items(), results, strict=True):
            invisible = task.keys() - {index for index, _ in rendered}
            if invisible:
                raise InputError(f"object {sources[min(invisible)]} has no view with enough points; leave it out")
            rng = np.random.default_rng([SEED, len(sources), min(task)])
            labels, clouds = [label_of[sources[index]] for index, _ in rendered], [cloud for _, cloud in rendered]
            chunks[file] = sample_clouds(clouds, labels, network, config, rng)
            save_arrays(file, chunks[file].arrays(), {})
            done += len(task)
            progress(done, len(sources))
    return Samples.concatenated([chunks[file] for file in tasks])


def sample_views(
    source: ViewSource,
    held_out: Mapping[int, NDArray[np.integer[Any]]],
    network: ColorNetwork,
    config: DescriptorConfig,
    seed: int,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> tuple[Samples, list[tuple[int, Cloud]]]:
    """Sample normalized views, except those of the held-out set.

    Args:
        source: normalized views.
        held_out: label -> indices of the views of the held-out set.
        network: colour network.
        config: descriptor. Static.
        seed: seed for the orientations.
        progress: called with (shards done, number of shards).

    Returns:
        The samples, and the label and the cloud (in metres) of each view of the held-out set. The clouds have no rim
        and no boundary.
    """
    fitted: list[Samples] = []
    kept: list[tuple[int, Cloud]] = []
    for index, shard in enumerate(source.shards):
        views, rng = source.read(index), np.random.default_rng([seed, index])
        is_kept = np.isin(views.view, held_out.get(shard.label, []))
        clouds = list(itertools.compress(views.clouds(), ~is_kept))
        if clouds:
            labels = [views.label] * len(clouds)
            fitted.append(sample_clouds(clouds, labels, network, config, rng, are_normal=True))
        for xyz, rgb in itertools.compress(views.clouds(), is_kept):
            # The slice is copied, since it would keep all views of the shard in memory.
            kept.append((views.label, (xyz / np.float32(config.sigma_s), rgb.copy())))
        progress(index + 1, len(source.shards))
    return Samples.concatenated(fitted), kept
