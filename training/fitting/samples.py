"""Training samples: normalized views, mirrored and cut into strips (paper, section "Training").

    samples = build_samples(ViewDataset.open("views"), network, config)
    batch = samples.take(np.arange(256))                                  # padded host arrays
    strips = expand(batch, region_sets(network).weights, config)          # on the device, under jit

A sample stores the data for computing its descriptor: the length of each occupied strip, and the number of its points
for each set of colour regions. This takes some hundred bytes instead of 48 kB for TOPS2.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import strips_by_sets
from thor2_jax.descriptor.slicing import RegionSets, region_sets
from thor2_jax.descriptor.view_normalization import mirror, turn
from thor2_jax.errors import InputError
from thor2_jax.types import Strips
from training.views.normalized_views import ViewSource, padded_batches, reorient

__all__ = ["Batch", "MIRRORS", "PAPER_MIRRORS", "Samples", "build_samples", "expand"]

MIRRORS = ("", "x")
"""Mirrors of a normalized view that change its descriptor. A mirror in y changes no strip length and no count."""

PAPER_MIRRORS = ("", "x", "y", "xy")
"""The four mirrors of the paper."""

PADDING = np.iinfo(np.uint16).max
"""Strip index of padding."""


class Batch(NamedTuple):
    """B samples, padded to E strips and C colour counts; `expand` turns them into strips.

    Attributes:
        strip: [B, E] uint16, slice x n_strips + strip; PADDING after the sample's last strip.
        length: [B, E] float32, largest minus smallest y of the strip, scaled units.
        color_strip: [B, C] uint16, strip of a colour count; PADDING after the sample's last count.
        color_set: [B, C] uint16, set of colour regions that is counted.
        color_count: [B, C] float32, number of points of the strip with this set (weights for a relaxed descriptor).
        label: [B] int32.
    """

    strip: Any
    length: Any
    color_strip: Any
    color_set: Any
    color_count: Any
    label: Any


@dataclasses.dataclass(frozen=True)
class Samples:
    """Training samples in compact form, as host arrays: the fields of `Batch` for one sample after the other.

    Attributes:
        strip_start: [M + 1] int64, index of each sample's first entry in `strip` and `length`; the last one is T.
        color_start: [M + 1] int64, index of each sample's first colour count; the last one is U.
        strip: [T] uint16.
        length: [T] float32.
        color_strip: [U] uint16.
        color_set: [U] uint16.
        color_count: [U] float32.
        label: [M] int32, index into `classes`.
        view: [M] int32, index of the view among the views of its object; mirrored and augmented copies share it.
        classes: class names.
    """

    strip_start: NDArray[np.int64]
    color_start: NDArray[np.int64]
    strip: NDArray[np.uint16]
    length: NDArray[np.float32]
    color_strip: NDArray[np.uint16]
    color_set: NDArray[np.uint16]
    color_count: NDArray[np.float32]
    label: NDArray[np.int32]
    view: NDArray[np.int32]
    classes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.label)

    @functools.cached_property
    def _most(self) -> tuple[int, int]:
        return int(np.diff(self.strip_start).max()), int(np.diff(self.color_start).max())

    def take(self, rows: NDArray[np.integer[Any]]) -> Batch:
        """Return the samples with the given indices, padded to the largest size of all samples."""
        strips, in_strips = _entries(self.strip_start, rows, self._most[0])
        colors, in_colors = _entries(self.color_start, rows, self._most[1])
        strip = np.where(in_strips, self.strip[strips], PADDING)
        color_strip = np.where(in_colors, self.color_strip[colors], PADDING)
        counts = self.color_set[colors], self.color_count[colors]
        return Batch(strip, self.length[strips], color_strip, *counts, self.label[rows])


def _entries(
    start: NDArray[np.int64], rows: NDArray[np.integer[Any]], most: int
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the indices [B, most] of the rows' entries, and a mask of those that are not padding."""
    index = start[rows, None] + np.arange(most)
    inside = index < start[rows + 1, None]
    return np.where(inside, index, 0), inside


def build_samples(
    source: ViewSource,
    network: ColorNetwork,
    config: DescriptorConfig,
    progress: Callable[[int, int], object] = lambda done, total: None,
    mirrors: Sequence[str] = MIRRORS,
    orientations: int = 0,
    seed: int = 0,
) -> Samples:
    """Mirror every view and compute its strips, reading one shard of views at a time.

    Args:
        source: normalized views.
        network: colour network that defines the regions.
        config: descriptor. Static.
        progress: called with (views done, number of views).
        mirrors: axes of each mirror, such as "xy"; each mirror gives one sample.
        orientations: number of additional samples of each view, in random orientations.
        seed: seed for the orientations.

    Raises:
        InputError: there are fewer than two classes, a class has no views, or the source is unreadable.
    """
    if len(source.classes) < 2:
        raise InputError(f"there are views of {len(source.classes)} classes; expected at least two; add objects")
    for label, name in enumerate(source.classes):
        if not any(shard.label == label and shard.views for shard in source.shards):
            raise InputError(f"class {name!r} has no views; render more views or leave it out")
    sets = region_sets(network)
    # With one "region" per set, colour vectors count the sets, so they are sparse with integer values.
    counting = RegionSets(sets.of_color, jnp.eye(len(sets.weights)))
    chunks: list[dict[str, NDArray[Any]]] = []
    all_done, total = 0, sum(shard.views for shard in source.shards)
    for index, shard in enumerate(source.shards):
        views, rng = source.read(index), np.random.default_rng([seed, index])
        done = 0
        for count, normal in padded_batches(views.clouds()):
            copies = (mirror(normal, axes) for axes in mirrors)
            for copy in itertools.chain(copies, (reorient(normal, rng) for _ in range(orientations))):
                strips = strips_by_sets(turn(copy, config), counting, config)
                compact = _compact(jax.tree.map(lambda a: np.asarray(a)[:count], strips))  # noqa: B023
                compact["label"] = np.full(count, shard.label, np.int32)
                chunks.append(compact | {"view": views.view[done : done + count]})
            done += count
            progress(all_done + done, total)
        all_done += done
    fields = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in chunks[0]}
    for name in ("strip", "color"):
        fields[f"{name}_start"] = np.concatenate([[0], np.cumsum(fields.pop(f"{name}_entries"), dtype=np.int64)])
    return Samples(classes=tuple(source.classes), **fields)


def _compact(strips: Strips) -> dict[str, NDArray[Any]]:
    n_samples = len(strips.low)
    occupied = np.asarray(strips.occupied).reshape(n_samples, -1)
    counts = np.asarray(strips.color).reshape(*occupied.shape, -1)
    sample, strip = np.nonzero(occupied)
    # Only a tenth of the strips is occupied.
    entry, color_set = np.nonzero(counts[sample, strip])
    return {
        "strip": strip.astype(np.uint16),
        "length": (strips.high - strips.low).reshape(n_samples, -1)[sample, strip],
        "strip_entries": occupied.sum(axis=1),
        "color_strip": strip[entry].astype(np.uint16),
        "color_set": color_set.astype(np.uint16),
        "color_count": counts[sample[entry], strip[entry], color_set],
        "color_entries": np.bincount(sample[entry], minlength=n_samples),
    }


def expand(batch: Batch, set_weights: jax.Array, config: DescriptorConfig) -> Strips:
    """Return the strips of a batch, fields [B, S, J] and [B, S, J, R], for `describe_strips`; call it under jit.

    Args:
        batch: batch from `Samples.take`.
        set_weights: [K, R], region weights of each set of regions (`RegionSets.weights`).
        config: descriptor. Static.

    Returns:
        The strips. `low` is 0 and `high` is the length of a strip, since descriptors depend on the length only.
        `overflow` is 0.
    """
    shape = config.n_slices, config.n_strips
    n_strips, n_regions = shape[0] * shape[1], set_weights.shape[1]

    def one(sample: Batch) -> Strips:
        # Indices out of range, such as padding, are dropped.
        high = jnp.zeros(n_strips, jnp.float32).at[sample.strip].set(sample.length, mode="drop")
        occupied = jnp.zeros(n_strips, bool).at[sample.strip].set(True, mode="drop")
        weights = sample.color_count[:, None] * set_weights[sample.color_set]
        color = jnp.zeros((n_strips, n_regions), jnp.float32).at[sample.color_strip].add(weights, mode="drop")
        low, overflow = jnp.zeros(shape, jnp.float32), jnp.zeros((), jnp.int32)
        return Strips(low, high.reshape(shape), occupied.reshape(shape), color.reshape(*shape, n_regions), overflow)

    return jax.vmap(one)(batch)
