"""Samples that an embedding is fitted on: the strips of clouds in random orientations.

A sample stores only its occupied strips, about a tenth of all, and the statistics of its cloud.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.cloud_statistics import balanced_histogram, cloud_statistics
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.view_normalization import turn, view_normalize
from thor2_jax.types import Cloud
from training.augmentation.orientation import reorient
from training.views.normalized_views import padded_batches

__all__ = ["Batch", "Samples", "sample_clouds"]

CLOUDS_PER_BATCH = 64


class Batch(NamedTuple):
    """B samples as host arrays; the strips of a batch give its descriptors.

    Attributes:
        length: [B, S, J] float16, largest less smallest y of each strip, scaled units; 0 if it is empty.
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
        """Return the samples of all chunks; there is at least one."""
        return cls(**{name: np.concatenate([chunk.arrays()[name] for chunk in chunks]) for name in chunks[0].arrays()})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays by the names of the fields."""
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
        """Return the samples with the given indices as a batch; `config` is that of the samples."""
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
    copies: int,
    rng: np.random.Generator,
    are_normal: bool = False,
) -> Samples:
    """Return samples of clouds, each in `copies` random orientations.

    Args:
        clouds: xyz [n, 3] float32 metres in the camera frame, or normalized; rgb [n, 3] uint8. At least one.
        labels: of the clouds.
        network: colour network.
        config: descriptor. Static.
        copies: samples of each cloud.
        rng: generator of the orientations.
        are_normal: whether the clouds are normalized. They stay in their order; clouds of one size share a batch
            otherwise, so that little of it is padding.
    """
    order = range(len(clouds)) if are_normal else sorted(range(len(clouds)), key=lambda k: len(clouds[k][0]))
    label = np.array([labels[k] for k in order], np.int32)
    chunks: list[Samples] = []
    done = 0
    for count, batch in padded_batches([clouds[k] for k in order], CLOUDS_PER_BATCH):
        normal = batch if are_normal else view_normalize(batch, config)
        sides = jnp.max(normal.points, axis=1)
        balanced = balanced_histogram(normal.colors, normal.mask)
        for _ in range(copies):
            occupied = strips(turn(reorient(normal, rng), config), network, config)
            statistics = np.hstack([cloud_statistics(sides, normal, occupied), balanced])[:count]
            sample, strip = np.nonzero(np.asarray(occupied.occupied)[:count].reshape(count, -1))
            length = np.asarray(occupied.high - occupied.low).reshape(CLOUDS_PER_BATCH, -1)
            color = np.asarray(occupied.color).reshape(*length.shape, -1)
            at, named = (sample, strip), label[done : done + count]
            of_strips = strip.astype(np.uint16), length[at].astype(np.float16), color[at].astype(np.float16)
            chunks.append(Samples(np.bincount(sample, minlength=count), *of_strips, statistics, named))
        done += count
    return Samples.concatenated(chunks)
