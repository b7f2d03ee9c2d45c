"""Chunks: the instances of a frame, computed a few at a time.

JAX dispatches asynchronously: the device computes one chunk while the host prepares the next.
"""

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

from thor2_jax.capacity import BATCH_BUCKETS, batch_bucket, batch_points
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.types import PointClouds

__all__ = ["compute_by_chunks", "padded_rows"]

MIN_PART = 32
"""A chunk is padded to at least 1 / MIN_PART of its size: commands, whose chunks are large, compile fewer sizes."""

T = TypeVar("T")


def compute_by_chunks(
    instances: Iterable[PreparedInstance], size: int, compute: Callable[[PointClouds], T]
) -> tuple[list[PreparedInstance], T]:
    """Prepare instances and compute something of the usable ones.

    Args:
        instances: an iterator that prepares them, one after the other.
        size: usable instances in a chunk.
        compute: function from the clouds of a chunk, padded to `padded_rows`, to arrays [B, ...] as a pytree; it is
            called at least once.

    Returns:
        All instances, and the arrays of the usable ones on the host, padded with zeros to whole batch buckets.
    """
    prepared: list[PreparedInstance] = []
    chunk: list[PreparedInstance] = []
    results: list[T] = []

    def compute_chunk() -> None:
        capacity = batch_points(len(instance.points) for instance in chunk) if size > MIN_PART else None
        results.append(compute(pack_instances(chunk, padded_rows(len(chunk), size), capacity)))
        chunk.clear()

    for instance in instances:
        prepared.append(instance)
        if instance.reason is None:
            chunk.append(instance)
            if len(chunk) == size:
                compute_chunk()
    if chunk or not results:
        compute_chunk()
    n_rows = padded_rows(sum(instance.reason is None for instance in prepared), size)

    def concatenate(*arrays: jax.Array) -> NDArray[Any]:
        padding = np.zeros((n_rows - sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype)
        return np.concatenate([*arrays, padding])

    return prepared, jax.tree.map(concatenate, *results)


def padded_rows(n: int, size: int) -> int:
    """Return the rows that `n` instances in chunks of `size` are padded to: largest batches, then a batch bucket.

    There are at least `size` / `MIN_PART` rows, and at least one.
    """
    whole = n // BATCH_BUCKETS[-1] * BATCH_BUCKETS[-1]
    return n if n == whole > 0 else whole + batch_bucket(max(n - whole, size // MIN_PART, 1))
