"""Large batches on CPUs: a few parts at a time, so that the tables of a part stay in the caches."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp

from thor2_jax.types import PointClouds

__all__ = ["in_parts", "part_size"]

T = TypeVar("T")

LARGEST, MOST_POINTS = 64, 2**17
"""Clouds that a part has at most, and points, padding included."""

AT_ONCE = 4
"""Parts of one program, so that one goes on where another waits for a core."""


def part_size(clouds: PointClouds) -> int:
    """Clouds of a part; `clouds` themselves are one where that many or fewer, or on another device than a CPU."""
    n_clouds, capacity = clouds.mask.shape
    if jax.default_backend() != "cpu":
        return n_clouds
    return max(1, min(LARGEST, MOST_POINTS // max(capacity, 1)))


def in_parts(function: Callable[[PointClouds], T], clouds: PointClouds) -> T:
    """`function(clouds)`, computed `AT_ONCE` parts at a time. To be called under `jax.jit`.

    Args:
        function: clouds [B, N] to arrays [B, ...], each cloud by itself.
        clouds: [B, N].
    """
    n_clouds, size = len(clouds.mask), part_size(clouds)
    if n_clouds <= size:
        return function(clouds)

    def part(first: int, last: int) -> PointClouds:
        return jax.tree.map(lambda a: a[first:last], clouds)

    group = size * AT_ONCE
    if n_clouds <= group:
        return _joined([function(part(k, min(k + size, n_clouds))) for k in range(0, n_clouds, size)])
    n_groups = n_clouds // group
    groups = jax.tree.map(lambda a: a.reshape(n_groups, group, *a.shape[1:]), part(0, n_groups * group))
    found = jax.lax.map(lambda one: in_parts(function, one), groups)
    found = jax.tree.map(lambda a: a.reshape(n_groups * group, *a.shape[2:]), found)
    if n_groups * group == n_clouds:
        return found
    return _joined([found, in_parts(function, part(n_groups * group, n_clouds))])


def _joined(found: Sequence[T]) -> T:
    joined: T = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *found)
    return joined
