"""Training samples: clouds, mirrored or in random orientations, and cut into strips (paper, section "Training").

    samples, _ = sample_views(ViewDataset.open("views"), network, config)
    batch = samples.take(np.arange(256), network, config)                    # padded host arrays
    descriptors = describe_batch(batch, network, config)                     # on the device, under jit

A sample stores only the nonzero lengths and colours of its strips: about a kilobyte instead of 48 kB for TOPS2.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from colornet import ColorNetwork
from thor2_jax import DescriptorConfig, describe_strips, mirror, strips, turn
from thor2_jax.descriptor.looks import balanced_histogram, cloud_statistics
from thor2_jax.types import Cloud, Descriptors, Parameters, PointClouds, Strips
from training.views.normalized_views import ViewSource, padded_batches, reorient

__all__ = ["MIRRORS", "OF_EMBEDDING", "Batch", "Form", "Samples", "describe_batch", "sample_normalized", "sample_views"]

MIRRORS = ("", "x")
"""Mirrors of a normalized view that change its descriptor. A mirror in y changes no strip length and no count."""


class Form(NamedTuple):
    """The copies of each cloud, of which each gives one sample, and the values that a sample stores.

    Attributes:
        mirrors: axes of each mirrored copy, such as "xy".
        orientations: number of copies in random orientations.
        of_embedding: whether the samples are for an embedding, which needs their statistics. Their strips are then
            rounded to float16.
    """

    mirrors: Sequence[str] = MIRRORS
    orientations: int = 0
    of_embedding: bool = False


OF_CLASSIFIERS = Form()
OF_EMBEDDING = Form((), orientations=2, of_embedding=True)


class Batch(NamedTuple):
    """B samples as host arrays, from which `describe_batch` computes the descriptors.

    Attributes:
        length: [B, S, J], largest minus smallest y of each strip, scaled units; 0 for an empty strip.
        color: [B, S, J, R], colour vectors of the strips.
        statistics: [B, 12 + R + N_BALANCED] float32, from `cloud_statistics` and `balanced_histogram`; [B, 0] for
            classifiers.
        label: [B] int32.
    """

    length: Any
    color: Any
    statistics: Any
    label: Any


ARRAYS = ("shape", "data", "indices", "indptr", "statistics", "label", "view")
"""Names of the arrays of stored samples: first those of the sparse matrix."""


@dataclasses.dataclass(frozen=True)
class Samples:
    """M samples in compact form.

    Attributes:
        strips: [M, S x J x (1 + R)] float32, a sparse matrix, since most strips and colour regions are empty: length
            and colour vector of each strip.
        statistics: as in a batch, [M, ...].
        label: [M] int32.
        view: [M] int32, index of the view among the views of its object; all copies of a view share it.
    """

    strips: csr_array
    statistics: NDArray[np.float32]
    label: NDArray[np.int32]
    view: NDArray[np.int32]

    @classmethod
    def concatenated(cls, chunks: Sequence["Samples"]) -> "Samples":
        """Return the samples of all chunks, of which there must be at least one."""
        strips, *others = zip(*(vars(chunk).values() for chunk in chunks), strict=True)
        return cls(vstack(strips, "csr"), *map(np.concatenate, others))

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> "Samples":
        """Return the samples with these `arrays`; raise an error if one is missing or has another shape."""
        shape, *matrix, statistics, label, view = (arrays[name] for name in ARRAYS)
        return cls(csr_array(tuple(matrix), tuple(shape)), statistics, label, view)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return name -> array."""
        others = self.statistics, self.label, self.view
        values = np.array(self.strips.shape), self.strips.data, self.strips.indices, self.strips.indptr, *others
        return dict(zip(ARRAYS, values, strict=True))

    def __len__(self) -> int:
        return len(self.label)

    def select(self, rows: NDArray[np.integer[Any]]) -> "Samples":
        """Return the samples with the given indices."""
        return Samples(*(values[rows] for values in vars(self).values()))

    def take(self, rows: NDArray[np.integer[Any]], network: ColorNetwork, config: DescriptorConfig) -> Batch:
        """Return the samples with the given indices as a batch.

        Args:
            rows: the indices.
            network: colour network of the samples.
            config: descriptor of the samples, or one with fewer slices, to which the batch is cut.
        """
        shape = config.n_slices, config.n_strips, 1 + network.n_regions
        strips = self.strips[rows, : math.prod(shape)].toarray().reshape(-1, *shape)
        return Batch(strips[..., 0], strips[..., 1:], self.statistics[rows], self.label[rows])

    def batches(
        self, rows: NDArray[np.integer[Any]], size: int, network: ColorNetwork, config: DescriptorConfig
    ) -> Iterator[Batch]:
        """Yield the samples with the given indices in batches of one size; the last one is filled with the first."""
        for chunk in np.resize(rows, -(-len(rows) // size) * size).reshape(-1, size):
            yield self.take(chunk, network, config)


def describe_batch(
    batch: Batch, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """Return the descriptors of the samples of a batch; the arguments are those of `describe_strips`."""
    length, color = jnp.asarray(batch.length, jnp.float32), jnp.asarray(batch.color, jnp.float32)
    occupied = length > 0  # the pair of a strip with one point has no persistence and adds nothing to the image
    strips = Strips(jnp.zeros_like(length), length, occupied, color, jnp.zeros(len(length), jnp.int32))
    return describe_strips(strips, network, config, parameters)


def sample_normalized(
    batches: Iterable[tuple[int, PointClouds]],
    label: NDArray[np.int32],
    view: NDArray[np.int32],
    network: ColorNetwork,
    config: DescriptorConfig,
    rng: np.random.Generator,
    form: Form,
) -> Samples:
    """Return the samples of normalized clouds.

    Args:
        batches: number of clouds and batch of normalized clouds, as `padded_batches` yields them; at least one batch.
        label: [M] int32, label of each cloud.
        view: [M] int32, index of each view among the views of its object.
        network: colour network.
        config: descriptor. Static.
        rng: generator of the orientations.
        form: form of the samples.
    """
    chunks: list[Samples] = []
    done = 0
    for count, normal in batches:
        named = label[done : done + count], view[done : done + count]
        if form.of_embedding:
            sides, balanced = jnp.max(normal.points, axis=1), balanced_histogram(normal.colors, normal.mask)
        mirrored = (mirror(normal, axes) for axes in form.mirrors)
        for copy in itertools.chain(mirrored, (reorient(normal, rng) for _ in range(form.orientations))):
            cut = strips(turn(copy, config), network, config)
            length = np.where(cut.occupied, cut.high - cut.low, 0)
            values = np.concatenate([length[..., None], cut.color], axis=-1)[:count].reshape(count, -1)
            statistics = np.zeros((count, 0), np.float32)
            if form.of_embedding:
                values = values.astype(np.float16).astype(np.float32)
                statistics = np.hstack([cloud_statistics(sides, normal, cut), balanced])[:count]
            chunks.append(Samples(csr_array(values), statistics, *named))
        done += count
    return Samples.concatenated(chunks)


def sample_views(
    source: ViewSource,
    network: ColorNetwork,
    config: DescriptorConfig,
    form: Form = OF_CLASSIFIERS,
    seed: int = 0,
    progress: Callable[[int, int], object] = lambda done, total: None,
    held_out: Mapping[int, NDArray[np.integer[Any]]] | None = None,
) -> tuple[Samples, list[tuple[int, Cloud]]]:
    """Sample normalized views, except those of the held-out set, reading one shard of views at a time.

    Args:
        source: normalized views, of which at least one is not in the held-out set.
        network: colour network.
        config: descriptor. Static.
        form: form of the samples; by default for classifiers.
        seed: seed for the orientations.
        progress: called with (views done, number of views).
        held_out: label -> indices of the views of the held-out set; by default there is none.

    Returns:
        The samples, and the label and the cloud (in metres) of each view of the held-out set. The clouds have no rim
        and no boundary. The camera is at the origin, except in views of earlier
        versions.

    Raises:
        InputError: the source is unreadable.
    """
    chunks: list[Samples] = []
    kept: list[tuple[int, Cloud]] = []
    done, total = 0, sum(shard.views for shard in source.shards)
    for index, shard in enumerate(source.shards):
        views, rng = source.read(index), np.random.default_rng([seed, index])
        is_kept = np.isin(views.view, (held_out or {}).get(shard.label, []))
        clouds, view = list(itertools.compress(views.clouds(), ~is_kept)), views.view[~is_kept]
        if clouds:
            label = np.full(len(clouds), shard.label, np.int32)
            chunks.append(sample_normalized(padded_batches(clouds), label, view, network, config, rng, form))
        for (xyz, rgb), camera in itertools.compress(zip(views.clouds(), views.camera, strict=True), is_kept):
            # The slice is copied, since it would keep all views of the shard in memory.
            kept.append((shard.label, ((xyz - camera) / np.float32(config.sigma_s), rgb.copy())))
        done += len(views)
        progress(done, total)
    return Samples.concatenated(chunks), kept
