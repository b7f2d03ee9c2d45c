"""Hypothesis strategies for coloured point clouds, RGB-D frames and colour networks.

A cloud is a pair (xyz [n, 3] float32, rgb [n, 3] uint8), as `PointClouds.pack` takes it. NumPy generates the points
from a seed that Hypothesis draws, which is a thousand times as fast as drawing each coordinate. Hypothesis shrinks the
number of points and the kind of the cloud.

>>> from thor2_jax.testing import camera_clouds, packed
>>> batches = packed(camera_clouds(kinds=("balls", "thin")), size=4, capacity=512)
"""

import math
from collections.abc import Sequence

import hypothesis.strategies as st
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colornet import ColorNetwork
from colornet.colors import GRID_SIZE, grid_colors
from thor2_jax.config import DescriptorConfig
from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.types import Cloud, PointClouds

__all__ = [
    "KINDS",
    "aligned_clouds",
    "camera_clouds",
    "decided_clouds",
    "frames",
    "lattice_clouds",
    "networks",
    "packed",
    "rotations",
    "seeds",
]

Points = NDArray[np.float64]

LATTICE = 1 / 2048
"""Step of the coordinates of `lattice_clouds`, metres."""

BODY_COPIES = 8
"""Number of symmetric copies of each body point of a decided cloud."""


def seeds() -> st.SearchStrategy[int]:
    """Generate seeds for NumPy's random generators."""
    return st.integers(0, 2**32 - 1)


def rotations() -> st.SearchStrategy[NDArray[np.float64]]:
    """Generate uniformly distributed rotation matrices [3, 3]."""
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
    """A surface with noise and a few outliers."""
    points = _revolutions(rng, n) + rng.normal(scale=0.03, size=(n, 3))
    outlier = rng.random(n) < 0.03
    return np.where(outlier[:, None], rng.uniform(-2, 2, (n, 3)), points)


def _partial(rng: np.random.Generator, n: int) -> Points:
    """A body cut by a plane, as if seen from one side or partly occluded."""
    body = (_boxes, _balls, _revolutions)[rng.integers(3)](rng, 4 * n + 4)
    along = body @ _balls(rng, 1)[0]
    return body[np.argsort(along)[: len(along) // 2]][:n]


def _degenerate(rng: np.random.Generator, n: int) -> Points:
    """Equal points, two distinct points, a line, a line along an axis, or the corners of a cube."""
    t = rng.uniform(-1, 1, (n, 1))
    return [
        np.zeros((n, 3)),
        np.sign(t) * rng.uniform(-1, 1, 3),
        t * rng.uniform(-1, 1, 3),
        t * np.eye(3)[rng.integers(3)],
        rng.choice([-1.0, 1.0], (n, 3)),
    ][rng.integers(5)]


_SHAPES = (_boxes, _balls, _revolutions, _thin, _flat, _noisy, _partial, _degenerate)
_MAKERS = {maker.__name__.removeprefix("_"): maker for maker in _SHAPES}

KINDS = tuple(_MAKERS)
"""Kinds of clouds; each includes empty clouds and clouds of a single point."""


def _colors(rng: np.random.Generator, n: int) -> NDArray[np.uint8]:
    """Draw from a few colours, or draw each colour at random."""
    palette = rng.integers(0, 256, (int(rng.integers(1, 6)), 3), dtype=np.uint8)
    return palette[rng.integers(len(palette), size=n)] if rng.random() < 0.7 else rng.integers(0, 256, (n, 3), np.uint8)


def _camera_cloud(seed: int, kind: str, n: int) -> Cloud:
    rng = np.random.default_rng(seed)
    points = _MAKERS[kind](rng, n) * rng.uniform(0.02, 0.12)
    points = points @ Rotation.random(random_state=seed).as_matrix().T
    points += rng.uniform([-0.3, -0.3, 0.4], [0.3, 0.3, 1.2])
    return points.astype(np.float32), _colors(rng, len(points))


def camera_clouds(kinds: Sequence[str] = KINDS, max_points: int = 512) -> st.SearchStrategy[Cloud]:
    """Generate clouds of objects 4 to 24 cm across in the frame of a camera at the origin (metres, OpenCV convention).

    Args:
        kinds: a selection of `KINDS`.
        max_points: largest number of points; clouds may be empty.
    """
    return st.builds(_camera_cloud, seeds(), st.sampled_from(kinds), st.integers(0, max_points))


def _lattice_cloud(seed: int, kind: str, exponent: int) -> Cloud:
    points, rgb = _camera_cloud(seed, kind, 2**exponent)
    return np.round(points / np.float32(LATTICE)).clip(-1023, 2047) * np.float32(LATTICE), rgb


def lattice_clouds(kinds: Sequence[str] = KINDS) -> st.SearchStrategy[Cloud]:
    """Generate camera clouds on which sums and means are exact in float32, so that properties hold without tolerance.

    Coordinates are integer multiples of `LATTICE` below 1 m, and the number of points is a power of two up to 512.
    Multiplied by sigma_s = 5/2, they are integer multiples of 2^-12. A sum of 512 coordinates, even if shifted by up to
    1 m, is less than 2^24 such units, and a mean of 2^k coordinates needs no more bits than the sum.
    """
    return st.builds(_lattice_cloud, seeds(), st.sampled_from(kinds), st.integers(0, 9))


def settled(points: Points, config: DescriptorConfig, margin: float = 0.1) -> Points:
    """Move aligned points [n, 3] within their strip and slice, away from the borders of both.

    Afterwards x and z are at least `margin` widths away from a border, so that rounding moves no point across a border.
    Coordinates of exactly 0 are kept, since aligned clouds touch 0 and there is no strip below.

    Args:
        points: scaled units, first octant.
        config: gives the widths of strips and slices.
        margin: fraction of a width, below 1/2.
    """
    moved = points.copy()
    for axis, width in ((0, config.sigma_2), (2, config.sigma_1)):
        inside = _move_inside(points[:, axis] / width, margin) * width
        moved[:, axis] = np.where(points[:, axis] == 0, 0, inside)
    return moved


def _aligned_cloud(seed: int, kind: str, n: int, config: DescriptorConfig, margin: float, reach: float) -> Cloud:
    rng = np.random.default_rng(seed)
    points = _MAKERS[kind](rng, n) @ Rotation.random(random_state=seed).as_matrix().T
    points = points - points.min(axis=0, initial=np.inf)
    # Scale the longest side to a fraction of the extent of the descriptor along each axis.
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
    """Generate clouds as `align` returns them, in scaled units and the first octant, and `settled`.

    Args:
        config: gives widths and numbers of slices and strips.
        kinds: a selection of `KINDS`.
        max_points: largest number of points; clouds may be empty.
        margin: the margin of `settled`.
        reach: longest side as a fraction of the extent of the descriptor; above 1, some clouds overflow.
    """
    fixed = st.just(config), st.just(margin), st.just(reach)
    return st.builds(_aligned_cloud, seeds(), st.sampled_from(kinds), st.integers(0, max_points), *fixed)


def _decided_cloud(seed: int, n_body: int, config: DescriptorConfig) -> Cloud:
    rng, cell, s = np.random.default_rng(seed), config.sigma_2, math.sqrt(0.5)
    p = int(rng.integers(3, 7))
    side_z = (p + 0.4) * cell / s
    side_y = side_z * rng.uniform(1.4, 1.6)
    most = int(config.n_slices * config.sigma_1 / cell) - p - 2
    q = int(rng.integers(math.ceil(1.6 * side_y * s / cell), most + 1))
    side_x = (q + 0.3) * cell / s

    # Squares of evenly spaced numbers put the mean at a third of the side for any seed.
    along = ((np.arange(n_body) + rng.random(n_body)) / n_body) ** 2 * 0.8 + 0.05
    radius = np.interp(along, np.linspace(0, 1, 5), rng.uniform(0.2, 0.8, 5))
    angle = rng.uniform(0, 2 * math.pi, n_body)
    a, b = radius * np.cos(angle), radius * np.sin(angle)
    body = [(along, y * first, z * second) for first, second in ((a, b), (b, a)) for y in (1, -1) for z in (1, -1)]
    corners = np.array([(x, y, z) for x in (0, 1) for y in (-1, 1) for z in (-1, 1)], float)
    points = np.concatenate([corners, *(np.stack(copy, axis=1) for copy in body)])
    points = (points * [1, 0.5, 0.5] + [0, 0.5, 0.5]) * [side_x, side_y, side_z]

    # Settled in the aligned frame: at pi/4, mirroring in z exchanges the two coordinates, so both stay settled.
    across = s * (points[:, 0] - points[:, 2] + side_z), s * (points[:, 0] + points[:, 2])
    low, high = (np.where(np.arange(len(points)) < len(corners), c, _move_inside(c / cell) * cell) for c in across)
    points[:, 0], points[:, 2] = (low + high) * s - side_z / 2, (high - low) * s + side_z / 2

    camera = rng.uniform([0, 0, -2.5], [side_x, side_y, -1.25])
    seen = (points - camera) @ Rotation.random(random_state=seed).as_matrix().T / config.sigma_s
    rgb = _colors(rng, len(points))
    order = rng.permutation(len(points))
    return seen[order].astype(np.float32), rgb[order]


def _move_inside(places: Points, margin: float = 0.15) -> Points:
    """Move coordinates within their cells of width 1 to at least `margin` from the borders."""
    cell, place = np.divmod(places, 1)
    return cell + margin + (1 - 2 * margin) * place


def decided_clouds(config: DescriptorConfig, max_points: int = 488) -> st.SearchStrategy[Cloud]:
    """Generate camera clouds for which rounding cannot change any discrete choice of the pipeline.

    A body with a random profile fills a box with three different sides, whose corners belong to the cloud; the camera
    is at the origin. Body and corners are symmetric in the two shorter axes of the box, so that its axes are the
    principal ones and any rotation enlarges the box. The sides, and therefore the eigenvalues, differ clearly; the mean
    lies at about a third of the long side; the camera is well outside; and aligned points are at least 0.15 strips away
    from the borders of strips and slices. Properties of the complete pipeline hold on these clouds without exception,
    on other clouds except for ties.

    Args:
        config: config with alpha = pi/4.
        max_points: largest number of points, at least 136.

    Raises:
        ValueError: `config` has another alpha, or `max_points` is too small.
    """
    if config.alpha != math.pi / 4 or max_points < 17 * BODY_COPIES:
        raise ValueError(
            f"alpha is {config.alpha}, max_points {max_points}; expected pi/4 and at least {17 * BODY_COPIES}"
        )
    return st.builds(_decided_cloud, seeds(), st.integers(16, max_points // BODY_COPIES - 1), st.just(config))


def packed(clouds: st.SearchStrategy[Cloud], size: int, capacity: int) -> st.SearchStrategy[PointClouds]:
    """Generate batches of `size` clouds padded to `capacity` points, with cameras at the origin, all of one shape."""
    return st.lists(clouds, min_size=size, max_size=size).map(lambda batch: PointClouds.pack(batch, capacity))


def _network(seed: int, n_regions: int) -> ColorNetwork:
    rng = np.random.default_rng(seed)
    colors = grid_colors().astype(np.float64)
    # The regions are slabs along a random direction; each shares a tenth with the next.
    along = colors @ rng.normal(size=3)
    place = np.argsort(np.argsort(along)) / GRID_SIZE * n_regions
    region = place.astype(np.uint32)
    shared = (place - region > 0.9) & (region < n_regions - 1)
    bits = np.uint32(1) << region | np.where(shared, np.uint32(2) << region, np.uint32(0))
    member = (bits[:, None] >> np.arange(n_regions, dtype=np.uint32)) & 1
    counts = member.sum(axis=0).astype(np.int64)
    weights = rng.uniform(5, 50, max(n_regions - 1, 0))
    at = np.concatenate([[0], np.cumsum(weights)])
    return ColorNetwork(
        mean_rgb=member.T @ colors / counts[:, None],
        member_counts=counts,
        edges=np.stack([np.arange(n_regions - 1), np.arange(1, n_regions)], axis=1).astype(np.int64),
        edge_weights=weights,
        cyclic=np.zeros(n_regions - 1, bool),
        similarity=1 / (1 + np.abs(at[:, None] - at)),
        region_bits=bits.astype(np.uint32),
        n_raw_nodes=n_regions,
    )


def networks(n_regions: int = 5) -> st.SearchStrategy[ColorNetwork]:
    """Generate networks whose regions are overlapping slabs of the colour cube, connected in a chain.

    All networks with R regions have 2 R - 1 region sets, so that they share compiled functions.

    Args:
        n_regions: R, 1 to 32.
    """
    return st.builds(_network, seeds(), st.just(n_regions))


def _frame(seed: int, height: int, width: int, n_objects: int) -> RGBDFrame:
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[:height, :width]
    depth = 0.9 + 0.2 * row / height + rng.normal(scale=0.001, size=(height, width))
    labels = np.zeros((height, width), np.uint8)
    color = np.full((height, width, 3), rng.integers(0, 256, 3), np.uint8)
    for number in rng.choice(np.arange(1, 256), n_objects, replace=False):
        centre, radius = rng.uniform([0, 0], [height, width]), rng.uniform(0.1, 0.4, 2) * [height, width]
        inside = ((row - centre[0]) / radius[0]) ** 2 + ((column - centre[1]) / radius[1]) ** 2
        here = inside < 1
        depth[here] = rng.uniform(0.5, 0.8) - 0.05 * np.sqrt(1 - inside[here])
        labels[here] = number
        color[here] = rng.integers(0, 256, 3)
    depth[rng.random(depth.shape) < 0.02] = 0
    focal = rng.uniform(0.8, 2) * width
    intrinsics = Intrinsics(focal, focal * rng.uniform(0.98, 1.02), (width - 1) / 2, (height - 1) / 2)
    return RGBDFrame(color, np.rint(depth * 1000).astype(np.uint16), labels, intrinsics)


def frames(max_side: int = 120, max_objects: int = 5) -> st.SearchStrategy[RGBDFrame]:
    """Generate frames of ellipsoids in front of a slanted plane; some are occluded or cut by the border.

    Depth is in millimetres, uint16, with missing values; labels are uint8 and not consecutive.

    Args:
        max_side: largest height and width in pixels, at least 8.
        max_objects: largest number of instances; later ones occlude earlier ones.
    """
    side = st.integers(8, max_side)
    return st.builds(_frame, seeds(), side, side, st.integers(0, max_objects))
