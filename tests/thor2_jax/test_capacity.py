"""Choice of point and batch buckets."""

from collections.abc import Callable

import pytest
from refusals import assert_refused

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket


@pytest.mark.parametrize(("pick", "buckets"), [(point_bucket, POINT_BUCKETS), (batch_bucket, BATCH_BUCKETS)])
def test_smallest_bucket_that_holds(pick: Callable[[int], int], buckets: tuple[int, ...]) -> None:
    for n in range(buckets[-1] + 1):
        assert pick(n) == min(size for size in buckets if size >= n)


def test_buckets_double() -> None:
    assert POINT_BUCKETS == tuple(512 * 2**k for k in range(5))
    assert BATCH_BUCKETS == tuple(2**k for k in range(9))


@pytest.mark.parametrize(("pick", "name", "n"), [(point_bucket, "n_points", 8193), (batch_bucket, "n_clouds", 257)])
def test_sizes_beyond_the_largest_bucket_are_refused(pick: Callable[[int], int], name: str, n: int) -> None:
    assert_refused(rf"^{name} is {n}\b.*\b{n - 1}\b", pick, n)
