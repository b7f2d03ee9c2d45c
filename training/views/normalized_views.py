"""Normalized views: what the files of a dataset hold and what training sees."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import view_normalize
from thor2_jax.errors import InputError
from thor2_jax.types import Cloud, PointClouds

__all__ = ["MAX_COORDINATE", "COORDINATE_STEP", "NormalizedViews", "ViewSource", "normalize_views", "padded_batches"]

COORDINATE_STEP = 2.0**-14
"""Coordinates are rounded to multiples of this many scaled units (0.024 mm)."""

MAX_COORDINATE = COORDINATE_STEP * np.iinfo(np.uint16).max
"""Largest coordinate, scaled units (1.6 m): multiples of `COORDINATE_STEP` fit into 16 bits."""

CLOUDS_PER_BATCH = 64
"""Clouds normalized together."""


def padded_batches(clouds: Sequence[Cloud], size: int) -> Iterator[tuple[int, PointClouds]]:
    """Clouds (xyz [n, 3], rgb [n, 3]) in batches of one size, with empty clouds at the end of the last.

    Yields:
        How many clouds of the sequence are in the batch, and the batch, padded to its own bucket of points.

    Raises:
        InputError: a cloud with more points than the largest bucket.
    """
    empty: Cloud = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    for start in range(0, len(clouds), size):
        part = list(clouds[start : start + size])
        yield len(part), PointClouds.pack(part + [empty] * (size - len(part)))


@dataclasses.dataclass(frozen=True)
class NormalizedViews:
    """The normalized clouds of some views of one object.

    Attributes:
        xyz: [n, 3] float32, points of all views, one view after the other; scaled units, first octant, before the turn
            by alpha; multiples of `COORDINATE_STEP`.
        rgb: [n, 3] uint8.
        counts: [V] int64, points of each view.
        label: index of the object among the classes.
        view: [V] int32, index of the view's angles among those of its object.
        copy: [V] int32, 0 is the view as rendered, others are varied.
    """

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    counts: NDArray[np.int64]
    label: int
    view: NDArray[np.int32]
    copy: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.counts)

    def clouds(self) -> list[Cloud]:
        """The views one by one: xyz [n, 3] and rgb [n, 3], parts of this record's arrays."""
        ends = np.cumsum(self.counts)
        return [(self.xyz[end - n : end], self.rgb[end - n : end]) for n, end in zip(self.counts, ends, strict=True)]


class ViewSource(Protocol):
    """Normalized views, a shard at a time, each of one object: a `ViewDataset` on disk, or `MemoryViews`."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names."""

    @property
    def digest(self) -> str:
        """Another one if any of the views is another."""

    @property
    def record(self) -> Mapping[str, Any]:
        """What a run keeps of them, as JSON holds it."""

    @property
    def shards(self) -> Sequence[Any]:
        """One entry for each `read`, with `label`, and `views`, their number."""

    def read(self, index: int) -> NormalizedViews:
        """The views of a shard."""


def normalize_views(
    clouds: Sequence[Cloud], label: int, view: Sequence[int], copy: Sequence[int], config: DescriptorConfig
) -> NormalizedViews:
    """Normalize views of one object. The same clouds in the same order give the same bits.

    Args:
        clouds: of the views: xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8.
        label: index of the object among the classes.
        view: index of each view's angles among those of its object.
        copy: of each view, 0 as rendered.
        config: only `sigma_s` is used.

    Raises:
        InputError: a cloud with more points than the largest bucket, or longer than `MAX_COORDINATE`.
    """
    xyz = [np.zeros((0, 3), np.float32)]
    # On the CPU of whatever machine: an accelerator rounds otherwise, and a job that renders need not hold its memory.
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for count, batch in padded_batches(clouds, CLOUDS_PER_BATCH):
            normal = view_normalize(batch, config)
            points, mask = np.asarray(normal.points)[:count], np.asarray(normal.mask)[:count]
            xyz.append(np.rint(points[mask] / np.float32(COORDINATE_STEP)) * np.float32(COORDINATE_STEP))
    joined = np.concatenate(xyz)
    if not (joined <= MAX_COORDINATE).all():
        raise InputError(f"a view is {joined.max():.3g} scaled units long, more than {MAX_COORDINATE:.3g}")
    return NormalizedViews(
        xyz=joined,
        rgb=np.concatenate([np.zeros((0, 3), np.uint8), *(rgb for _, rgb in clouds)]),
        counts=np.array([len(xyz) for xyz, _ in clouds], np.int64),
        label=label,
        view=np.array(view, np.int32),
        copy=np.array(copy, np.int32),
    )
