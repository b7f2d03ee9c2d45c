"""Descriptors of more clouds than fit into memory, a batch at a time."""

import itertools
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import numpy as np

from colornet import ColorNetwork
from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["describe_stream"]


def describe_stream(
    clouds: Iterable[tuple[Any, Any]],
    network: ColorNetwork,
    config: DescriptorConfig,
    capacity: int | None = None,
    batch: int = BATCH_BUCKETS[-1],
) -> Iterator[Descriptors]:
    """Describe clouds batch by batch, in order; memory does not grow with their number.

    The next batch is packed while the last one is computed.

    Args:
        clouds: pairs (xyz, rgb) as `PointClouds.pack` takes them; read lazily.
        network: the colour network.
        config: the descriptor. Static.
        capacity: padded number of points; by default each batch's own bucket.
        batch: clouds described together. One more compilation for another number.

    Yields:
        Descriptors of up to `batch` clouds, host arrays.

    Raises:
        InputError: a batch that is not positive, or a cloud that `PointClouds.pack` refuses; the message gives its
            index in its batch.
    """
    if batch < 1:
        raise InputError(f"batch is {batch}; it must be at least 1")
    return _stream(iter(clouds), network, config, capacity, batch)


def _stream(
    clouds: Iterator[tuple[Any, Any]], network: ColorNetwork, config: DescriptorConfig, capacity: int | None, batch: int
) -> Iterator[Descriptors]:
    running: deque[tuple[int, Descriptors]] = deque()
    while part := list(itertools.islice(clouds, batch)):
        nothing = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        packed = PointClouds.pack(part + [nothing] * (batch - len(part)), capacity)
        running.append((len(part), describe(packed, network, config)))
        if len(running) > 1:
            yield _fetched(*running.popleft())
    while running:
        yield _fetched(*running.popleft())


def _fetched(count: int, descriptors: Descriptors) -> Descriptors:
    return jax.tree.map(lambda a: np.asarray(a)[:count], descriptors)
