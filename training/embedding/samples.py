"""Samples that an embedding is fitted on: the strips of views in random orientations.

    samples = build_samples(sources, "samples", views=16, pool=local_workers(2))
    batch = samples.take(np.arange(256))

A sample stores its occupied strips, a tenth of all, and the statistics of its cloud. Shards on disk hold the samples of
some objects each, so that an interrupted sampling resumes at the first missing shard.
"""

import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colornet import ColorNetwork
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.view_normalization import turn, view_normalize
from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, write_text
from thor2_jax.gallery.embedding import cloud_statistics
from thor2_jax.types import Cloud, PointClouds
from training.embedding.views import AUGMENTATIONS, ObjectSource, ViewTask, render_clouds
from training.storage.jobs import check_same_job
from training.storage.locks import locked
from training.storage.workers import IN_PROCESS, WorkerPool
from training.views.normalized_views import padded_batches

__all__ = ["Batch", "Samples", "build_samples", "sample_clouds"]

OBJECTS_PER_SHARD = 32
CLOUDS_PER_BATCH = 64

NEARLY_EQUAL = 0.85
"""Least ratio of two neighbouring sides of a box at which they are swapped in half of the samples."""

MAX_ROTATION = 10.0
"""Largest random rotation of a normalized cloud, degrees."""

JOB = "job.json"


class Batch(NamedTuple):
    """B samples as host arrays; the strips of a batch give its descriptors.

    Attributes:
        length: [B, S, J] float16, largest less smallest y of each strip, scaled units; 0 if it is empty.
        color: [B, S, J, R] float16, colour vectors of the strips.
        statistics: [B, 12 + R] float32, from `cloud_statistics`.
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
        start: [M + 1] int64, index of each sample's first strip, and the number of all strips.
        strip: [T] uint16, slice x J + strip.
        length: [T] float16.
        color: [T, R] float16.
        statistics: [M, 12 + R] float32.
        label: [M] int32.
        shape: S and J.
    """

    start: NDArray[np.int64]
    strip: NDArray[np.uint16]
    length: NDArray[np.float16]
    color: NDArray[np.float16]
    statistics: NDArray[np.float32]
    label: NDArray[np.int32]
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.label)

    def take(self, rows: NDArray[np.integer[Any]]) -> Batch:
        """Return the samples with the given indices."""
        counts = self.start[rows + 1] - self.start[rows]
        sample = np.repeat(np.arange(len(rows)), counts)
        entry = np.arange(counts.sum()) + np.repeat(self.start[rows] - np.cumsum(counts) + counts, counts)
        strip = self.strip[entry]
        n_strips = self.shape[0] * self.shape[1]
        length = np.zeros((len(rows), n_strips), np.float16)
        color = np.zeros((len(rows), n_strips, self.color.shape[1]), np.float16)
        length[sample, strip], color[sample, strip] = self.length[entry], self.color[entry]
        grid = len(rows), *self.shape
        return Batch(length.reshape(grid), color.reshape(*grid, -1), self.statistics[rows], self.label[rows])


@jax.jit
def _reoriented(normal: PointClouds, axes: jax.Array, mirrored: jax.Array) -> PointClouds:
    """Rotate normalized clouds to axes [B, 3, 3], then mirror some [B] in x; the camera stays on the side of -z."""

    def one(cloud: PointClouds, axes: jax.Array, mirrored: jax.Array) -> PointClouds:
        inside = cloud.mask[:, None]
        middle = cloud.points.max(axis=0) / 2
        points, camera = (jnp.matmul(a - middle, axes.T) for a in (cloud.points, cloud.camera))
        low = jnp.where(inside, points, jnp.inf).min(axis=0)
        high = jnp.where(inside, points, -jnp.inf).max(axis=0)
        signs = jnp.stack([mirrored, jnp.zeros_like(mirrored), camera[2] > (low[2] + high[2]) / 2])
        corner = jnp.where(signs, high, low)
        corner = jnp.where(jnp.isfinite(corner), corner, 0)
        sign = jnp.where(signs, -1, 1)
        points = jnp.where(inside, sign * (points - corner), 0)
        return dataclasses.replace(cloud, points=points, camera=sign * (camera - corner))

    return jax.vmap(one)(normal, axes, mirrored)


def _random_axes(extents: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return axes [B, 3, 3]: some nearly equal sides [B, 3] swapped, then a small rotation about a random axis."""
    sides, axes = extents.copy(), np.tile(np.eye(3), (len(extents), 1, 1))
    for order, (i, j) in (([1, 0, 2], (0, 1)), ([0, 2, 1], (1, 2))):
        swap = (sides[:, j] > NEARLY_EQUAL * sides[:, i]) & (rng.random(len(sides)) < 0.5)
        sides[swap], axes[swap] = sides[swap][:, order], axes[swap][:, order]
    direction = rng.standard_normal((len(extents), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    angle = np.radians(rng.uniform(0, MAX_ROTATION, (len(extents), 1)))
    return np.asarray(Rotation.from_rotvec(angle * direction).as_matrix() @ axes, np.float32)


def sample_clouds(
    clouds: Sequence[Cloud],
    labels: Sequence[int],
    network: ColorNetwork,
    config: DescriptorConfig,
    copies: int,
    rng: np.random.Generator,
) -> dict[str, NDArray[Any]]:
    """Return the fields of samples of clouds, each in `copies` random orientations.

    Args:
        clouds: xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8.
        labels: of the clouds.
        network: colour network.
        config: descriptor. Static.
        copies: samples of each cloud.
        rng: generator of the orientations.
    """
    # Clouds of one size share a batch, so that little of it is padding.
    order = sorted(range(len(clouds)), key=lambda k: len(clouds[k][0]))
    chunks: list[dict[str, NDArray[Any]]] = []
    for first, (count, batch) in zip(
        range(0, len(order), CLOUDS_PER_BATCH),
        padded_batches([clouds[k] for k in order], CLOUDS_PER_BATCH),
        strict=True,
    ):
        normal = view_normalize(batch, config)
        extents = jnp.max(normal.points, axis=1)
        label = np.array([labels[k] for k in order[first : first + count]], np.int32)
        for _ in range(copies):
            axes, mirrored = _random_axes(np.asarray(extents), rng), rng.random(CLOUDS_PER_BATCH) < 0.5
            occupied = strips(turn(_reoriented(normal, axes, mirrored), config), network, config)
            mass = occupied.color.sum(axis=(1, 2))
            statistics = np.asarray(cloud_statistics(extents, normal.colors, normal.mask, mass))[:count]
            sample, strip = np.nonzero(np.asarray(occupied.occupied)[:count].reshape(count, -1))
            length = np.asarray(occupied.high - occupied.low).reshape(CLOUDS_PER_BATCH, -1)
            color = np.asarray(occupied.color).reshape(*length.shape, -1)
            chunks.append(
                {
                    "strips": np.bincount(sample, minlength=count),
                    "strip": strip.astype(np.uint16),
                    "length": length[sample, strip].astype(np.float16),
                    "color": color[sample, strip].astype(np.float16),
                    "statistics": statistics,
                    "label": label,
                }
            )
    return _concatenate(chunks)


def _concatenate(chunks: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


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
    label_of = {source: index for index, source in reversed(list(enumerate(sources)))}
    job = {
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(config),
        "color_network": network.fingerprint,
        "objects": [str(source) for source in sources],
        "views": views,
        "copies": copies,
        "seed": seed,
        "augmentations": AUGMENTATIONS.record(),
    }
    with locked(directory):
        _begin(directory, job)
        starts = range(0, len(sources), OBJECTS_PER_SHARD)
        files = {first: directory / f"{first:05d}.safetensors" for first in starts}
        missing = [first for first in starts if not files[first].is_file()]
        progress((len(starts) - len(missing)) * OBJECTS_PER_SHARD, len(sources))
        with closing(pool(render_clouds, _tasks(sources, missing, views, seed))) as results:
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
        fields = _concatenate([safetensors.numpy.load_file(file) for file in files.values()])
    start = np.concatenate([[0], np.cumsum(fields.pop("strips"), dtype=np.int64)])
    return Samples(start=start, shape=(config.n_slices, config.n_strips), **fields)


def _begin(directory: Path, job: Mapping[str, Any]) -> None:
    """Write the job to a new directory, or check that the directory is of this job."""
    path = directory / JOB
    if path.is_file():
        check_same_job(directory, json.loads(path.read_text()), job)
    else:
        write_text(path, json.dumps(job, indent=1) + "\n")


def _tasks(sources: Sequence[ObjectSource], starts: Sequence[int], views: int, seed: int) -> Iterator[ViewTask]:
    for first in starts:
        yield ViewTask(dict(list(enumerate(sources))[first : first + OBJECTS_PER_SHARD]), views, seed)
