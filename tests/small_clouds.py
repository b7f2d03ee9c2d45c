"""Small clouds of points, and the colour network and the constants by which they are described."""

from collections.abc import Iterable, Sequence

import numpy as np

import colornet
import thor2_jax as thor2
from thor2_jax.types import Cloud

NETWORK = colornet.load_default()
CLOSED = thor2.DescriptorConfig(homology="closed_form")


def aligned_cloud(seed: int, n: int) -> Cloud:
    """Return random points in the first octant, none within 1e-5 of a border of slices or strips, and colours."""
    rng = np.random.default_rng(seed)
    points = (rng.random((n, 3)) * (0.76, 0.4, 0.68)).astype(np.float32)
    for axis, width in ((0, 0.025), (2, 0.1)):
        border = np.round(points[:, axis] / width) * width
        points[np.abs(points[:, axis] - border) < 1e-5, axis] += np.float32(1e-3)
    return points, rng.integers(0, 256, (n, 3), dtype=np.uint8)


DEGENERATE = {
    "nothing": np.zeros((0, 3)),
    "one point": np.array([[0.1, 0.2, 0.9]]),
    "two points": np.array([[0.1, 0.2, 0.9], [0.2, 0.2, 0.8]]),
    "all equal": np.full((101, 3), 0.7),
    "line": np.linspace(0, 0.2, 101)[:, None] * [1.0, 2.0, -1.0] + 0.5,
    "plane": np.random.default_rng(0).random((101, 2)) @ [[0.1, 0, 0.1], [0, 0.1, 0]] + 0.5,
    "cube": np.stack(np.meshgrid(*[[-0.1, 0.0, 0.1]] * 3), axis=-1).reshape(-1, 3),
}
"""Points of clouds whose frame is ambiguous."""


def random_clouds(
    seed: int, sizes: Iterable[int], extent: Sequence[float] = (0.2, 0.1, 0.05), color: object = None
) -> list[Cloud]:
    """Return boxes of random points, half a metre before the camera, in random colours or all in one colour."""
    rng = np.random.default_rng(seed)
    return [
        (
            (rng.random((n, 3)) * extent + [0, 0, 0.5]).astype(np.float32),
            rng.integers(0, 256, (n, 3), np.uint8) if color is None else np.full((n, 3), color, np.uint8),
        )
        for n in sizes
    ]


def brick_and_stick(views: int, seed: int = 0) -> dict[str, list[Cloud]]:
    """Return views of two objects that differ in shape and colour."""
    return {
        "red brick": random_clouds(seed, [200] * views, (0.1, 0.05, 0.03), 0),
        "stick": random_clouds(seed + 1, [200] * views, (0.2, 0.01, 0.01), 255),
    }
