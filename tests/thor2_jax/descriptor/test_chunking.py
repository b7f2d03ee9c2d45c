"""Chunks of large batches: their sizes, and the order of the results."""

import jax
import numpy as np
import pytest

import thor2_jax as thor2
from thor2_jax.descriptor.describe import CHUNKS_PER_STEP, chunk_size, map_chunks


def clouds_of(count: int, capacity: int) -> thor2.PointClouds:
    """Return clouds, the k-th of which lies at x = k."""
    points = np.zeros((count, capacity, 3), np.float32)
    points[:, :, 0] = np.arange(count)[:, None]
    return thor2.PointClouds.pack([(cloud, np.zeros((capacity, 3), np.uint8)) for cloud in points], capacity)


@pytest.mark.parametrize(("capacity", "size"), [(1, 64), (512, 64), (2048, 64), (4096, 32), (8192, 16), (2**18, 1)])
def test_chunks_have_few_points_except_on_accelerators(
    capacity: int, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert chunk_size(clouds_of(2, capacity)) == size
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert chunk_size(clouds_of(300, 1)) == 300


@pytest.mark.parametrize("count", [1, 16, 17, 63, 64, 65, 127, 128, 150])
def test_results_equal_those_of_the_whole_batch(count: int) -> None:
    sizes: list[int] = []

    def mean_x(chunk: thor2.PointClouds) -> dict[str, jax.Array]:
        sizes.append(len(chunk.mask))
        return {"x": chunk.points[:, :, 0].mean(axis=1), "points": chunk.points}

    clouds = clouds_of(count, 8192)  # chunks of 16
    results = jax.jit(lambda clouds: map_chunks(mean_x, clouds))(clouds)
    assert max(sizes) <= 16 and len(sizes) <= 2 * CHUNKS_PER_STEP
    np.testing.assert_array_equal(results["x"], np.arange(count))
    np.testing.assert_array_equal(results["points"], clouds.points)
