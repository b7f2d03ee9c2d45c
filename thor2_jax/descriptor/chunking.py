"""Large batches on CPUs, computed a chunk of clouds at a time so that intermediate tables stay in the caches.

`map_chunks(function, clouds)` equals `function(clouds)`, the plain version, for any function that treats each cloud by
itself. `map_large_chunks` does the same outside `jax.jit`, with larger chunks. On accelerators both are the plain
version.
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp

from thor2_jax.types import PointClouds

__all__ = ["chunk_size", "map_chunks", "map_large_chunks"]

T = TypeVar("T")

MAX_CHUNK_CLOUDS = 64
"""Largest number of clouds in a chunk."""

MAX_CHUNK_POINTS = 2**17
"""Largest number of points in a chunk, padding included."""

CHUNKS_PER_STEP = 4
"""Chunks in one step of the loop; XLA can run them concurrently."""

MAX_LARGE_CHUNK_POINTS = 2**19
"""Largest number of points in a large chunk, padding and all looks included."""


def chunk_size(clouds: PointClouds) -> int:
    """Return the number of clouds in a chunk. On an accelerator the whole batch is one chunk."""
    n_clouds, capacity = clouds.mask.shape
    if jax.default_backend() != "cpu":
        return n_clouds
    return max(1, min(MAX_CHUNK_CLOUDS, MAX_CHUNK_POINTS // max(capacity, 1)))


def map_chunks(function: Callable[[PointClouds], T], clouds: PointClouds) -> T:
    """Return `function(clouds)`, computed `CHUNKS_PER_STEP` chunks at a time. Call it under `jax.jit`.

    Args:
        function: maps clouds [B, N] to arrays [B, ...] and treats each cloud by itself.
        clouds: [B, N].
    """
    n_clouds, size = len(clouds.mask), chunk_size(clouds)
    clouds_per_step = size * CHUNKS_PER_STEP
    if n_clouds <= clouds_per_step:
        return _map_slices(function, clouds, size)
    n_steps, rest = divmod(n_clouds, clouds_per_step)
    head = jax.tree.map(lambda a: a[: n_clouds - rest].reshape(n_steps, clouds_per_step, *a.shape[1:]), clouds)
    results = jax.lax.map(lambda step: _map_slices(function, step, size), head)
    results = jax.tree.map(lambda a: a.reshape(n_clouds - rest, *a.shape[2:]), results)
    if rest == 0:
        return results
    tail = jax.tree.map(lambda a: a[n_clouds - rest :], clouds)
    return _concatenate([results, _map_slices(function, tail, size)])


def map_large_chunks(function: Callable[[PointClouds], T], clouds: PointClouds, looks: int) -> T:
    """Return `function(clouds)`, computed for one large chunk after the other.

    Args:
        function: maps clouds [B, N] to arrays [B, ...] and treats each cloud by itself.
        clouds: [B, N].
        looks: number of looks at each cloud that the function describes.
    """
    n_clouds, capacity = clouds.mask.shape
    size = max(1, MAX_LARGE_CHUNK_POINTS // (max(capacity, 1) * looks))
    if jax.default_backend() != "cpu" or n_clouds <= size:
        return function(clouds)
    return _map_slices(function, clouds, size)


def _map_slices(function: Callable[[PointClouds], T], clouds: PointClouds, size: int) -> T:
    starts = range(0, max(len(clouds.mask), 1), size)
    return _concatenate([function(jax.tree.map(lambda a, k=k: a[k : k + size], clouds)) for k in starts])


def _concatenate(results: Sequence[T]) -> T:
    concatenated: T = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *results)
    return concatenated
