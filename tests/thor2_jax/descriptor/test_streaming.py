"""A stream of clouds against one batch; clouds are read when they are needed."""

from collections.abc import Iterator

import numpy as np
import pytest
from helpers import slow

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.describe import describe_stream

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(homology="closed_form")


def clouds(count: int, seed: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    for _ in range(count):
        n = int(rng.integers(1, 300))
        yield rng.random((n, 3)) * (0.2, 0.1, 0.05), rng.integers(0, 256, (n, 3), dtype=np.uint8)


@pytest.mark.parametrize("count", [8, *slow(1, 4, 9)])
def test_against_one_batch(count: int) -> None:
    batches = list(describe_stream(clouds(count), NETWORK, CONFIG, capacity=512, batch=4))
    assert [len(p.overflow) for p in batches] == [4] * (count // 4) + ([count % 4] if count % 4 else [])
    whole = thor2.describe(thor2.PointClouds.pack(list(clouds(count)), 512), NETWORK, CONFIG)
    np.testing.assert_allclose(np.concatenate([p.tops2 for p in batches]), whole.tops2, atol=1e-5)
    np.testing.assert_array_equal(np.concatenate([p.overflow for p in batches]), whole.overflow)


def test_clouds_are_read_two_batches_ahead_at_most() -> None:
    read = 0

    def counted() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        nonlocal read
        for cloud in clouds(40):
            read += 1
            yield cloud

    stream = describe_stream(counted(), NETWORK, CONFIG, capacity=512, batch=4)
    assert read == 0
    for done in range(1, 6):
        next(stream)
        assert read == 4 * (done + 1)


def test_bad_input() -> None:
    with pytest.raises(thor2.InputError, match="batch is 0"):
        next(describe_stream(clouds(2), NETWORK, CONFIG, batch=0))
    bad = [*clouds(2), (np.full((3, 3), np.nan), np.zeros((3, 3), np.uint8))]
    with pytest.raises(thor2.InputError, match="2"):
        list(describe_stream(bad, NETWORK, CONFIG, capacity=512, batch=4))
