"""Chunks of instances: order, padding, and frames without usable instances."""

from collections.abc import Iterator

import numpy as np
import pytest

from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.inference import compute_by_chunks
from thor2_jax.types import PointClouds


def instance(label: int) -> PreparedInstance:
    """Return an instance with `label` points; every third one cannot be used."""
    arrays = np.zeros((label, 3), np.float32), np.zeros((label, 3), np.uint8), np.zeros(label, bool)
    return PreparedInstance(label, *arrays, reason=None if label % 3 else "too small")


@pytest.mark.parametrize("n", [0, 1, 3, 4, 7, 65])
@pytest.mark.parametrize("size", [1, 3, 4, 10_000])
def test_chunks_give_the_rows_of_all_usable_instances(n: int, size: int) -> None:
    labels = range(1, n + 1)
    usable = [label for label in labels if label % 3]
    sizes: list[int] = []

    def compute(clouds: PointClouds) -> dict[str, np.ndarray]:
        sizes.append(len(clouds.points))
        return {"count": np.asarray(clouds.mask).sum(axis=1)}

    instances, result = compute_by_chunks(map(instance, labels), size, compute)
    assert [each.label for each in instances] == list(labels)
    counts = result["count"]
    np.testing.assert_array_equal(counts[: len(usable)], usable)
    assert not counts[len(usable) :].any() and len(counts) in BATCH_BUCKETS
    assert len(sizes) == max(1, -(-len(usable) // size)) and set(sizes) <= set(BATCH_BUCKETS)


def test_instances_are_prepared_between_chunks() -> None:
    """The second chunk is prepared after the first one was given to the device."""
    events: list[str] = []

    def prepare() -> Iterator[PreparedInstance]:
        for label in (1, 2, 4, 5):
            events.append(f"prepare {label}")
            yield instance(label)

    compute_by_chunks(prepare(), 2, lambda clouds: events.append("compute") or np.zeros(len(clouds.points)))
    assert events == ["prepare 1", "prepare 2", "compute", "prepare 4", "prepare 5", "compute"]
