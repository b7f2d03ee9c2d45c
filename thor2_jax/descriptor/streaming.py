"""Describe more clouds than fit into memory, batch by batch."""

import itertools
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
    """Describe clouds batch by batch, in order; memory use does not grow with their number.

    The next batch is packed while the previous one is computed.

    Args:
        clouds: pairs (xyz, rgb) as `PointClouds.pack` takes them, read lazily.
        network: the colour network.
        config: static.
        capacity: padded number of points; by default the bucket of each batch's largest cloud.
        batch: number of clouds described together. Each number compiles once.

    Yields:
        Descriptors of up to `batch` clouds, as NumPy arrays.

    Raises:
        InputError: `batch` is not positive, or `PointClouds.pack` rejects a cloud; the message gives the index of the
            cloud in its batch.
    """
    if batch < 1:
        raise InputError(f"batch is {batch}; expected at least 1")
    return _stream(iter(clouds), network, config, capacity, batch)


def _stream(
    clouds: Iterator[tuple[Any, Any]], network: ColorNetwork, config: DescriptorConfig, capacity: int | None, batch: int
) -> Iterator[Descriptors]:
    empty_cloud = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    running: list[tuple[int, Descriptors]] = []
    while chunk := list(itertools.islice(clouds, batch)):
        packed = PointClouds.pack(chunk + [empty_cloud] * (batch - len(chunk)), capacity)
        running.append((len(chunk), describe(packed, network, config)))
        if len(running) > 1:
            yield _fetch(*running.pop(0))
    yield from (_fetch(*last) for last in running)


def _fetch(count: int, descriptors: Descriptors) -> Descriptors:
    return jax.tree.map(lambda a: np.asarray(a)[:count], descriptors)
