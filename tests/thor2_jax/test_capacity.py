"""Choice of point and batch buckets."""

from collections.abc import Callable

import pytest
from refusals import assert_refused

from thor2_jax.capacity import batch_bucket, point_bucket

POINTS = [512 * 2**k for k in range(5)]
CLOUDS = [2**k for k in range(9)]


@pytest.mark.parametrize(
    ("pick", "name", "buckets"), [(point_bucket, "n_points", POINTS), (batch_bucket, "n_clouds", CLOUDS)]
)
def test_smallest_bucket_that_holds(pick: Callable[[int], int], name: str, buckets: list[int]) -> None:
    largest = buckets[-1]
    for n in range(largest + 1):
        assert pick(n) == min(size for size in buckets if size >= n)
    assert_refused(rf"^{name} is {largest + 1}\b.*\b{largest}\b", pick, largest + 1)
