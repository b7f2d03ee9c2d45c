"""Labelled views as a training set: normalized, mirrored, cut into strips (paper, section "Training")."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.capacity import batch_bucket, point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor import strips
from thor2_jax.errors import InputError
from thor2_jax.types import PointClouds, Strips
from thor2_jax.view_normalization import mirror, turn, view_normalize
from training.views import Cloud

__all__ = ["MIRRORS", "StripDataset", "build_dataset"]

MIRRORS = ("", "x", "y", "xy")
"""Each normalized view is used four times."""

CHUNK = 64
"""Views normalized together."""


@dataclasses.dataclass(frozen=True)
class StripDataset:
    """Training samples in compact form; `describe_strips` expands a batch of them to descriptors.

    Attributes:
        strips: fields [M, S, J] and [M, S, J, R], host arrays.
        labels: [M] int32, index into `classes`.
        view: [M] int32, which view of its object a sample comes from; its mirrored copies share the number.
        classes: class names.
    """

    strips: Strips
    labels: NDArray[np.int32]
    view: NDArray[np.int32]
    classes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.labels)


def _chunks(clouds: Sequence[Cloud]) -> Iterable[Sequence[Cloud]]:
    for start in range(0, len(clouds), CHUNK):
        yield clouds[start : start + CHUNK]


def build_dataset(
    views: Mapping[str, Sequence[Cloud]],
    network: ColorNetwork,
    config: DescriptorConfig,
    mirrors: Sequence[str] = MIRRORS,
    progress: Callable[[int], object] = lambda n: None,
) -> StripDataset:
    """Normalize every view, mirror it, and keep its strips.

    Args:
        views: class name -> clouds (xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8).
        network: gives the colour regions.
        config: static.
        mirrors: axes to mirror in, one sample each.
        progress: called with the number of views done since the last call.

    Raises:
        InputError: no classes, or a class without views.
    """
    if not views:
        raise InputError("views is empty; at least one class is needed")
    parts: list[Strips] = []
    labels: list[NDArray[np.int32]] = []
    numbers: list[NDArray[np.int32]] = []
    for index, (name, clouds) in enumerate(views.items()):
        if len(clouds) == 0:
            raise InputError(f"class {name!r} has no views")
        capacity = point_bucket(max(len(xyz) for xyz, _ in clouds))
        first = 0
        for chunk in _chunks(clouds):
            empty: Cloud = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
            padded = [*chunk, *[empty] * (batch_bucket(len(chunk)) - len(chunk))]
            normal = view_normalize(PointClouds.pack(padded, capacity), config)
            for axes in mirrors:
                found = strips(turn(mirror(normal, axes), config), network, config)
                parts.append(jax.tree.map(lambda a: np.asarray(a)[: len(chunk)], found))  # noqa: B023
                labels.append(np.full(len(chunk), index, np.int32))
                numbers.append(np.arange(first, first + len(chunk), dtype=np.int32))
            first += len(chunk)
            progress(len(chunk))
    return StripDataset(
        strips=jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts),
        labels=np.concatenate(labels),
        view=np.concatenate(numbers),
        classes=tuple(views),
    )
