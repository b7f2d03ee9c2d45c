"""Samples that an embedding is fitted on: the strips of clouds in random orientations.

A sample stores its occupied strips, a tenth of all, and the statistics of its cloud.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.cloud_statistics import cloud_statistics
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.view_normalization import turn, view_normalize
from thor2_jax.types import Cloud, PointClouds
from training.views.normalized_views import padded_batches

__all__ = ["Batch", "Samples", "concatenate_fields", "sample_clouds"]

CLOUDS_PER_BATCH = 64

NEARLY_EQUAL = 0.85
"""Least ratio of two neighbouring sides of a box at which they are swapped in half of the samples."""

MAX_ROTATION = 10.0
"""Largest random rotation of a normalized cloud, degrees."""


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
            statistics = np.asarray(cloud_statistics(extents, normal, occupied))[:count]
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
    return concatenate_fields(chunks)


def concatenate_fields(chunks: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Concatenate the fields of samples."""
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
