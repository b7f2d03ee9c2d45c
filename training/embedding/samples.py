"""Samples that an embedding is fitted on: the strips of clouds in random orientations.

A sample stores only its occupied strips, about a tenth of all, and the statistics of its cloud.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
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

__all__ = ["Batch", "Samples", "concatenate_fields", "joined_samples", "sample_clouds"]

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
        start: [M + 1] int64, index of each sample's first strip, and the number of all strips.
        strip: [T] uint16, slice x J + strip.
        length: [T] float16.
        color: [T, R] float16.
        statistics: [M, 12 + R + N_BALANCED] float32.
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

    def _entries(self, rows: NDArray[np.integer[Any]]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the number of strips of each of the samples, and the indices of all their strips."""
        counts = self.start[rows + 1] - self.start[rows]
        return counts, np.arange(counts.sum()) + np.repeat(self.start[rows] - np.cumsum(counts) + counts, counts)

    def fields(self, rows: NDArray[np.integer[Any]]) -> dict[str, NDArray[Any]]:
        """Return the fields of the samples with the given indices, as `sample_clouds` returns them."""
        counts, entry = self._entries(rows)
        return {
            "strips": counts,
            "strip": self.strip[entry],
            "length": self.length[entry],
            "color": self.color[entry],
            "statistics": self.statistics[rows],
            "label": self.label[rows],
        }

    def take(self, rows: NDArray[np.integer[Any]]) -> Batch:
        """Return the samples with the given indices."""
        counts, entry = self._entries(rows)
        sample = np.repeat(np.arange(len(rows)), counts)
        strip = self.strip[entry]
        n_strips = self.shape[0] * self.shape[1]
        length = np.zeros((len(rows), n_strips), np.float16)
        color = np.zeros((len(rows), n_strips, self.color.shape[1]), np.float16)
        length[sample, strip], color[sample, strip] = self.length[entry], self.color[entry]
        grid = len(rows), *self.shape
        return Batch(length.reshape(grid), color.reshape(*grid, -1), self.statistics[rows], self.label[rows])

    def batches(self, rows: NDArray[np.integer[Any]], size: int) -> Iterator[Batch]:
        """Yield the samples with the given indices in batches of one size; the last one is filled with the first."""
        for chunk in np.resize(rows, -(-len(rows) // size) * size).reshape(-1, size):
            yield self.take(chunk)


def sample_clouds(
    clouds: Sequence[Cloud],
    labels: Sequence[int],
    network: ColorNetwork,
    config: DescriptorConfig,
    copies: int,
    rng: np.random.Generator,
    are_normal: bool = False,
) -> dict[str, NDArray[Any]]:
    """Return the fields of samples of clouds, each in `copies` random orientations.

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
    chunks: list[dict[str, NDArray[Any]]] = []
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
            chunks.append(
                {
                    "strips": np.bincount(sample, minlength=count),
                    "strip": strip.astype(np.uint16),
                    "length": length[sample, strip].astype(np.float16),
                    "color": color[sample, strip].astype(np.float16),
                    "statistics": statistics,
                    "label": label[done : done + count],
                }
            )
        done += count
    return concatenate_fields(chunks)


def concatenate_fields(chunks: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Concatenate the fields of samples."""
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}


def joined_samples(chunks: Sequence[Mapping[str, NDArray[Any]]], config: DescriptorConfig) -> Samples:
    """Return the samples of the fields that `sample_clouds` returns."""
    fields = concatenate_fields(chunks)
    start = np.concatenate([[0], np.cumsum(fields.pop("strips"), dtype=np.int64)])
    return Samples(start=start, shape=(config.n_slices, config.n_strips), **fields)
