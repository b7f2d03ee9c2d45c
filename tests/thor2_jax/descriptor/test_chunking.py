"""Large batches in parts: what a part sees, and that the results come back in order."""

import jax
import numpy as np
import pytest

import thor2_jax as thor2
from thor2_jax.descriptor.chunking import AT_ONCE, in_parts, part_size


def clouds_of(count: int, capacity: int) -> thor2.PointClouds:
    """Cloud k lies at x = k."""
    points = np.zeros((count, capacity, 3), np.float32)
    points[:, :, 0] = np.arange(count)[:, None]
    return thor2.PointClouds.pack([(cloud, np.zeros((capacity, 3), np.uint8)) for cloud in points], capacity)


@pytest.mark.parametrize(("capacity", "size"), [(1, 64), (512, 64), (2048, 64), (4096, 32), (8192, 16), (2**18, 1)])
def test_parts_have_few_points(capacity: int, size: int) -> None:
    assert part_size(clouds_of(2, capacity)) == size


def test_other_devices_see_all_clouds_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert part_size(clouds_of(300, 1)) == 300


@pytest.mark.parametrize("count", [1, 16, 17, 63, 64, 65, 127, 128, 150])
def test_results_are_in_the_order_of_the_clouds(count: int) -> None:
    seen: list[int] = []

    def mean_x(part: thor2.PointClouds) -> dict[str, jax.Array]:
        seen.append(len(part.mask))
        return {"x": part.points[:, :, 0].mean(axis=1), "points": part.points}

    clouds = clouds_of(count, 8192)  # parts of 16
    found = jax.jit(lambda clouds: in_parts(mean_x, clouds))(clouds)
    np.testing.assert_array_equal(found["x"], np.arange(count))
    np.testing.assert_array_equal(found["points"], clouds.points)
    assert max(seen) <= 16 and len(seen) <= 2 * AT_ONCE
