"""Buckets: the padded sizes of clouds and batches, shared by training, warm-up and service.

JAX compiles a function once for each shape of its arguments. A cloud is therefore padded to a point bucket, the
smallest of a few fixed numbers of points that holds it, and a batch to a batch bucket. Once every bucket in use has
been warmed up, no call compiles any more.
"""

from collections.abc import Iterable

from thor2_jax.errors import InputError

__all__ = ["BATCH_BUCKETS", "MIN_BATCH_POINTS", "POINT_BUCKETS", "batch_bucket", "batch_points", "point_bucket"]

POINT_BUCKETS = (512, 1024, 2048, 4096, 8192)
"""Padded numbers of points of a cloud."""

BATCH_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Padded numbers of clouds of a batch."""

MIN_BATCH_POINTS = 2048
"""Smallest padded number of points in batches of the commands and the service. Smaller sizes would save only a tenth of
the time, and each size takes seconds to compile."""


def _smallest_bucket(buckets: tuple[int, ...], n: int, name: str, advice: str) -> int:
    if n > buckets[-1]:
        raise InputError(f"{name} is {n}; expected at most {buckets[-1]}, the largest bucket; {advice}")
    return min(bucket for bucket in buckets if n <= bucket)


def point_bucket(n_points: int) -> int:
    """Return the smallest padded number of points that holds `n_points`.

    Raises:
        InputError: `n_points` exceeds the largest bucket.
    """
    return _smallest_bucket(POINT_BUCKETS, n_points, "n_points", "downsample the cloud with a coarser voxel grid")


def batch_bucket(n_clouds: int) -> int:
    """Return the smallest padded number of clouds that holds `n_clouds`.

    Raises:
        InputError: `n_clouds` exceeds the largest bucket.
    """
    return _smallest_bucket(BATCH_BUCKETS, n_clouds, "n_clouds", "split the batch")


def batch_points(counts: Iterable[int]) -> int:
    """Return the padded number of points for clouds with these numbers of points, in commands and the service.

    The result is at most the largest bucket; for clouds with more points, `PointClouds.pack` raises an error.
    """
    return point_bucket(min(max([MIN_BATCH_POINTS, *counts]), POINT_BUCKETS[-1]))
