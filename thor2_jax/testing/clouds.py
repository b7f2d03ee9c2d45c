"""Hypothesis strategies for coloured clouds: what laws are tried on.

A cloud is a pair (xyz [n, 3] float32, rgb [n, 3] uint8), as `PointClouds.pack` takes it. Points are made by NumPy from
a seed that Hypothesis draws, which is a thousand times as fast as drawing each coordinate; what shrinks is the number
of points and the kind of cloud.

>>> from thor2_jax.testing import camera_clouds, packed
>>> batches = packed(camera_clouds(kinds=("balls", "thin")), size=4, capacity=512)
"""

import math
from collections.abc import Callable, Sequence

import hypothesis.strategies as st
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thor2_jax.config import DescriptorConfig
from thor2_jax.types import PointClouds

__all__ = [
    "KINDS",
    "Cloud",
    "aligned_clouds",
    "camera_clouds",
    "decided_clouds",
    "lattice_clouds",
    "packed",
    "rotations",
    "seeds",
    "settled",
]

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]
Points = NDArray[np.float64]

LATTICE = 1 / 2048
"""Metres: step of the coordinates of `lattice_clouds`."""

BODY = 8
"""Copies of each point of the body of a decided cloud."""


def seeds() -> st.SearchStrategy[int]:
    """Seeds for NumPy's generators."""
    return st.integers(0, 2**32 - 1)


def rotations() -> st.SearchStrategy[NDArray[np.float64]]:
    """Rotation matrices [3, 3], spread evenly over all."""
    return st.builds(lambda seed: Rotation.random(random_state=seed).as_matrix(), seeds())


def _boxes(rng: np.random.Generator, n: int) -> Points:
    points = rng.uniform(-1, 1, (n, 3))
    axis = rng.integers(0, 3, n)
    points[np.arange(n), axis] = np.sign(points[np.arange(n), axis])
    return points * rng.uniform(0.2, 1, 3)


def _balls(rng: np.random.Generator, n: int) -> Points:
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _revolutions(rng: np.random.Generator, n: int) -> Points:
    height, angle = rng.uniform(-1, 1, n), rng.uniform(0, 2 * math.pi, n)
    radius = np.interp(height, np.linspace(-1, 1, 5), rng.uniform(0.1, 0.8, 5))
    return np.stack([height, radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _thin(rng: np.random.Generator, n: int) -> Points:
    return _boxes(rng, n) * [1, 0.03, 0.02]


def _flat(rng: np.random.Generator, n: int) -> Points:
    return rng.uniform(-1, 1, (n, 3)) * [1, rng.uniform(0.3, 1), 0]


def _noisy(rng: np.random.Generator, n: int) -> Points:
    """A surface with a camera's noise and a few strays."""
    points = _revolutions(rng, n) + rng.normal(scale=0.03, size=(n, 3))
    stray = rng.random(n) < 0.03
    return np.where(stray[:, None], rng.uniform(-2, 2, (n, 3)), points)


def _partial(rng: np.random.Generator, n: int) -> Points:
    """What a plane leaves of a body: seen from one side, or hidden in part."""
    body = (_boxes, _balls, _revolutions)[rng.integers(3)](rng, 4 * n + 4)
    along = body @ _balls(rng, 1)[0]
    return body[np.argsort(along)[: len(along) // 2]][:n]


def _degenerate(rng: np.random.Generator, n: int) -> Points:
    """Points that are equal, two places, a line, a line along an axis, or the corners of a cube."""
    t = rng.uniform(-1, 1, (n, 1))
    return [
        np.zeros((n, 3)),
        np.sign(t) * rng.uniform(-1, 1, 3),
        t * rng.uniform(-1, 1, 3),
        t * np.eye(3)[rng.integers(3)],
        rng.choice([-1.0, 1.0], (n, 3)),
    ][rng.integers(5)]


_MAKERS: dict[str, Callable[[np.random.Generator, int], Points]] = {
    "boxes": _boxes,
    "balls": _balls,
    "revolutions": _revolutions,
    "thin": _thin,
    "flat": _flat,
    "noisy": _noisy,
    "partial": _partial,
    "degenerate": _degenerate,
}

KINDS = tuple(_MAKERS)
"""Kinds of clouds. Of each there are empty ones and ones of a single point."""


def _colors(rng: np.random.Generator, n: int) -> NDArray[np.uint8]:
    """Patches of a few colours, or noise."""
    palette = rng.integers(0, 256, (int(rng.integers(1, 6)), 3), dtype=np.uint8)
    return palette[rng.integers(len(palette), size=n)] if rng.random() < 0.7 else rng.integers(0, 256, (n, 3), np.uint8)


def _camera_cloud(seed: int, kind: str, n: int) -> Cloud:
    rng = np.random.default_rng(seed)
    points = _MAKERS[kind](rng, n) * rng.uniform(0.02, 0.12)
    points = points @ Rotation.random(random_state=seed).as_matrix().T
    points += rng.uniform([-0.3, -0.3, 0.4], [0.3, 0.3, 1.2])
    return points.astype(np.float32), _colors(rng, len(points))


def camera_clouds(kinds: Sequence[str] = KINDS, max_points: int = 512) -> st.SearchStrategy[Cloud]:
    """Clouds of things 4 to 24 cm across as a camera at the origin sees them: metres, OpenCV frame.

    Args:
        kinds: of `KINDS`.
        max_points: largest number of points; there may be none.
    """
    return st.builds(_camera_cloud, seeds(), st.sampled_from(kinds), st.integers(0, max_points))


def _lattice_cloud(seed: int, kind: str, exponent: int) -> Cloud:
    points, rgb = _camera_cloud(seed, kind, 2**exponent)
    return np.round(points / np.float32(LATTICE)).clip(-1023, 2047) * np.float32(LATTICE), rgb


def lattice_clouds(kinds: Sequence[str] = KINDS) -> st.SearchStrategy[Cloud]:
    """Camera clouds on which sums and means are exact in float32: no law that sums alone could break needs a tolerance.

    Coordinates are whole multiples of `LATTICE` below 1 m, and the number of points is a power of two up to 512: times
    sigma_s = 5/2 they are whole multiples of 2^-12, 512 of them sum to less than 2^24 of these also when shifted by up
    to 1 m, and a mean of 2^k of them needs no more bits than the sum.
    """
    return st.builds(_lattice_cloud, seeds(), st.sampled_from(kinds), st.integers(0, 9))


def settled(points: Points, config: DescriptorConfig, margin: float = 0.1) -> Points:
    """Aligned points [n, 3] moved within their strip and slice away from the borders of both.

    Afterwards x and z are at least `margin` widths from a border, so that no rounding takes a point across one: hard
    slices and strips are decided by construction, and no example need be thrown away. Coordinates of exactly 0 stay:
    aligned clouds touch 0, and nothing is below.

    Args:
        points: scaled units, first octant.
        config: gives the widths.
        margin: share of a width, below 1/2.
    """
    moved = points.copy()
    for axis, width in ((0, config.sigma_2), (2, config.sigma_1)):
        inside = _inner(points[:, axis] / width, margin) * width
        moved[:, axis] = np.where(points[:, axis] == 0, 0, inside)
    return moved


def _aligned_cloud(seed: int, kind: str, n: int, config: DescriptorConfig, margin: float, reach: float) -> Cloud:
    rng = np.random.default_rng(seed)
    points = _MAKERS[kind](rng, n) @ Rotation.random(random_state=seed).as_matrix().T
    points = points - points.min(axis=0, initial=np.inf)
    # The largest side becomes a share of the descriptor's window along each axis.
    window = np.array([config.n_strips * config.sigma_2, config.window, config.n_slices * config.sigma_1])
    points *= window * rng.uniform(0.2, reach, 3) / max(points.max(initial=0), 1e-9)
    return settled(points, config, margin).astype(np.float32), _colors(rng, len(points))


def aligned_clouds(
    config: DescriptorConfig,
    kinds: Sequence[str] = KINDS,
    max_points: int = 512,
    margin: float = 0.1,
    reach: float = 1.0,
) -> st.SearchStrategy[Cloud]:
    """Clouds as `align` gives them: scaled units, first octant, and `settled`.

    Args:
        config: gives widths and numbers of slices and strips.
        kinds: of `KINDS`.
        max_points: largest number of points; there may be none.
        margin: of `settled`.
        reach: largest side as a share of what the descriptor holds; above 1, some clouds overflow.
    """
    return st.builds(
        lambda seed, kind, n: _aligned_cloud(seed, kind, n, config, margin, reach),
        seeds(),
        st.sampled_from(kinds),
        st.integers(0, max_points),
    )


def _decided_cloud(seed: int, n_body: int, config: DescriptorConfig) -> Cloud:
    rng, cell, s = np.random.default_rng(seed), config.sigma_2, math.sqrt(0.5)
    p = int(rng.integers(3, 7))
    side_z = (p + 0.4) * cell / s
    side_y = side_z * rng.uniform(1.4, 1.6)
    most = int(config.n_slices * config.sigma_1 / cell) - p - 2
    q = int(rng.integers(math.ceil(1.6 * side_y * s / cell), most + 1))
    side_x = (q + 0.3) * cell / s

    # Squares of evenly spread numbers: the mean lies at a third of the side, whatever the seed.
    along = ((np.arange(n_body) + rng.random(n_body)) / n_body) ** 2 * 0.8 + 0.05
    radius = np.interp(along, np.linspace(0, 1, 5), rng.uniform(0.2, 0.8, 5))
    angle = rng.uniform(0, 2 * math.pi, n_body)
    a, b = radius * np.cos(angle), radius * np.sin(angle)
    body = [(along, y * first, z * second) for first, second in ((a, b), (b, a)) for y in (1, -1) for z in (1, -1)]
    corners = np.array([(x, y, z) for x in (0, 1) for y in (-1, 1) for z in (-1, 1)], float)
    points = np.concatenate([corners, *(np.stack(part, axis=1) for part in body)])
    points = (points * [1, 0.5, 0.5] + [0, 0.5, 0.5]) * [side_x, side_y, side_z]

    # Settled in the aligned frame: at pi/4 mirroring in z exchanges the two coordinates, so both stay settled.
    across = s * (points[:, 0] - points[:, 2] + side_z), s * (points[:, 0] + points[:, 2])
    low, high = (np.where(np.arange(len(points)) < len(corners), c, _inner(c / cell) * cell) for c in across)
    points[:, 0], points[:, 2] = (low + high) * s - side_z / 2, (high - low) * s + side_z / 2

    camera = rng.uniform([0, 0, -2.5], [side_x, side_y, -1.25])
    seen = (points - camera) @ Rotation.random(random_state=seed).as_matrix().T / config.sigma_s
    rgb = _colors(rng, len(points))
    order = rng.permutation(len(points))
    return seen[order].astype(np.float32), rgb[order]


def _inner(places: Points, margin: float = 0.15) -> Points:
    """Places in cells of width 1, moved within their cell to at least `margin` from its borders."""
    cell, place = np.divmod(places, 1)
    return cell + margin + (1 - 2 * margin) * place


def decided_clouds(config: DescriptorConfig, max_points: int = 488) -> st.SearchStrategy[Cloud]:
    """Camera clouds whose every hard choice on the way to the descriptor has a margin: rounding cannot change any.

    A body with a random profile between the eight corners of a box of three different sides, the camera at the origin.
    Body and corners are symmetric in the box's two shorter axes: its axes are the principal ones, and every turn of the
    search for the box makes it larger. The sides and so the eigenvalues are well apart; the mean lies at about a third
    of the long side; the camera is well outside; aligned points are at least 0.15 strips from the borders of strips and
    slices. Laws of the whole way hold on these without exception; on other clouds they hold but for ties.

    Args:
        config: with alpha = pi/4.
        max_points: at least 136.

    Raises:
        ValueError: another alpha, or fewer points.
    """
    if config.alpha != math.pi / 4 or max_points < 17 * BODY:
        raise ValueError(f"alpha is {config.alpha}, max_points {max_points}; expected pi/4 and at least {17 * BODY}")
    return st.builds(
        lambda seed, n_body: _decided_cloud(seed, n_body, config), seeds(), st.integers(16, max_points // BODY - 1)
    )


def packed(clouds: st.SearchStrategy[Cloud], size: int, capacity: int) -> st.SearchStrategy[PointClouds]:
    """Batches of `size` clouds padded to `capacity` points, cameras at the origin: one shape, one compilation."""
    return st.lists(clouds, min_size=size, max_size=size).map(lambda parts: PointClouds.pack(parts, capacity))
