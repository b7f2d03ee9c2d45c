"""Which padded size a cloud or a batch gets: the one rule shared by training, warm-up and service.

A compiled function is tied to the shapes of its arguments. With sizes drawn from a short list, whatever is warmed up is
all that will ever be compiled.
"""

from thor2_jax.errors import InputError

__all__ = ["BATCH_BUCKETS", "POINT_BUCKETS", "batch_bucket", "point_bucket"]

POINT_BUCKETS = (512, 1024, 2048, 4096, 8192)
BATCH_BUCKETS = (1, 2, 4, 8, 16, 32, 64, 128, 256)


def _smallest(buckets: tuple[int, ...], n: int, what: str) -> int:
    for bucket in buckets:
        if n <= bucket:
            return bucket
    raise InputError(f"{n} {what}: more than the largest bucket, {buckets[-1]}")


def point_bucket(n_points: int) -> int:
    """Smallest padded number of points that holds `n_points`.

    Raises:
        InputError: more points than the largest bucket; voxel the cloud more coarsely.
    """
    return _smallest(POINT_BUCKETS, n_points, "points in a cloud")


def batch_bucket(n_clouds: int) -> int:
    """Smallest padded number of clouds that holds `n_clouds`.

    Raises:
        InputError: more clouds than the largest bucket; split the batch.
    """
    return _smallest(BATCH_BUCKETS, n_clouds, "clouds in a batch")
