"""Bounding boxes against rectangles (OpenCV), hulls (SciPy), an exhaustive search (trimesh) and known boxes."""

import itertools
from collections.abc import Callable

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from helpers import DEGENERATE
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from thor2_jax.descriptor.bounding_box import ROWS, _minimum_area_angle, argmax, fold, minimal_box, support_points

compiled_box, compiled_support = jax.jit(minimal_box), jax.jit(support_points)


def padded(points: np.ndarray, capacity: int = 512) -> np.ndarray:
    """Return the centred points, [3, N], padded with zeros."""
    out = np.zeros((3, capacity), np.float32)
    out[:, : len(points)] = (points - (points.mean(axis=0) if len(points) else 0)).T
    return out


def box_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes, float64, and the side lengths along them, measured on the points."""
    axes, low, high = (np.asarray(part, np.float64) for part in compiled_box(padded(points)))
    if len(points) == 0:
        return axes, np.zeros(3)
    turned = (points - points.mean(axis=0)) @ axes.T
    np.testing.assert_allclose([low, high], [turned.min(axis=0), turned.max(axis=0)], atol=1e-6 * np.abs(points).max())
    return axes, np.ptp(turned, axis=0)


def shapes() -> list[np.ndarray]:
    """Return randomly rotated clouds like those of objects: flat, long, round and partial."""
    rng = np.random.default_rng(0)
    clouds = []
    for k in range(24):
        points = rng.normal(size=(500, 3))
        if k % 3 == 0:
            points = rng.uniform(-1, 1, (500, 3))
        if k % 3 == 1:
            points = points / np.linalg.norm(points, axis=1, keepdims=True)
            points = points[points[:, 2] > rng.uniform(-0.5, 0.5)]
        points = points * rng.uniform(0.1, 1, 3) + rng.normal(scale=0.01, size=points.shape)
        clouds.append(points @ Rotation.random(random_state=k).as_matrix().T)
    return clouds


CLOUDS = {
    **DEGENERATE,
    "three points": np.array([[0, 0, 0], [1.0, 0, 0], [0, 2.0, 0]]),
    "ball": trimesh.creation.icosphere(2).vertices,
}


@pytest.mark.parametrize("name", CLOUDS)
def test_axes_of_degenerate_clouds_are_orthonormal(name: str) -> None:
    axes, sides = box_of(CLOUDS[name])
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-5)
    assert sides[0] >= sides[1] - 1e-5 and sides[1] >= sides[2] - 1e-5


def test_the_boxes_of_a_line_a_plane_and_a_cube() -> None:
    np.testing.assert_allclose(box_of(DEGENERATE["line"])[1], [0.2 * np.sqrt(6), 0, 0], atol=1e-5)
    assert box_of(DEGENERATE["plane"])[1][2] < 1e-5
    turned = DEGENERATE["cube"] @ Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix().T
    assert np.prod(box_of(turned)[1]) <= 0.2**3 * 1.05


@pytest.mark.parametrize("seed", range(10))
def test_finds_a_known_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sides = np.sort(rng.uniform(0.1, 1, 3))[::-1]
    corners = np.array(list(itertools.product((0, 1), repeat=3)))
    points = np.concatenate([corners, rng.random((301, 3))]) * sides
    lengths = box_of(points @ Rotation.random(random_state=seed).as_matrix().T)[1]
    assert np.prod(lengths) <= 1.03 * np.prod(sides)
    np.testing.assert_allclose(lengths, sides, rtol=0.03)


def test_volumes_against_an_exhaustive_search() -> None:
    ratios = [np.prod(box_of(points)[1]) / np.prod(trimesh.bounds.oriented_bounds(points)[1]) for points in shapes()]
    assert np.median(ratios) <= 1.02
    assert max(ratios) <= 1.08


def test_each_side_is_a_minimum_area_rectangle() -> None:
    ratios = []
    for points in shapes():
        axes, sides = box_of(points)
        turned = points @ axes.T
        for a, b in ((0, 1), (1, 2), (0, 2)):
            width, height = cv2.minAreaRect(turned[:, [a, b]].astype(np.float32))[1]
            ratios.append(sides[a] * sides[b] / (width * height))
    assert np.median(ratios) <= 1.005
    assert max(ratios) <= 1.08


def test_support_points_are_vertices_of_the_hull() -> None:
    for points in shapes():
        centred = padded(points).astype(np.float64)
        frame = np.linalg.svd(centred.T, full_matrices=False)[2]
        principal = (frame @ centred).astype(np.float32)
        support = np.asarray(compiled_support(principal))
        assert support.shape == (3, 66)
        cloud = principal[:, : len(points)].T
        corners = {tuple(row) for row in cloud[ConvexHull(cloud).vertices].tolist()}
        chosen = {tuple(row) for row in support.T.tolist()}
        assert chosen <= corners and len(chosen) >= 15
        for axis in range(3):  # includes the extremes of each axis
            assert {tuple(cloud[k].tolist()) for k in (cloud[:, axis].argmin(), cloud[:, axis].argmax())} <= chosen


def test_support_points_of_an_empty_cloud() -> None:
    np.testing.assert_array_equal(compiled_support(np.zeros((3, 16), np.float32)), np.zeros((3, 66)))


@pytest.mark.slow
@pytest.mark.parametrize("capacity", [528, 1024])
def test_padding_does_not_change_the_box(capacity: int) -> None:
    points = shapes()[1]
    axes = np.asarray(compiled_box(padded(points, capacity))[0], np.float64)
    np.testing.assert_allclose(np.abs(axes @ box_of(points)[0].T), np.eye(3), atol=1e-4)


def test_a_mirrored_projection_has_the_opposite_angle() -> None:
    """The signs of the initial frame of the search therefore do not matter."""
    minimum_area_angle = jax.jit(_minimum_area_angle)
    for seed in range(5):
        xy = np.random.default_rng(seed).normal(size=(2, 80)).astype(np.float32)
        angle = float(minimum_area_angle(xy))
        assert 0 < abs(angle) < np.pi / 4
        assert float(minimum_area_angle(xy * np.array([[1], [-1]], np.float32))) == pytest.approx(-angle, abs=1e-6)


def numbers(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("length", [16, 48])
def test_fold_combines_entries_a_row_apart(length: int) -> None:
    values = numbers(2, length)
    expected = values.astype(np.float64).reshape(2, ROWS, length // ROWS)
    for op, oracle in ((jnp.add, np.sum), (jnp.minimum, np.min)):
        folded = jax.jit(fold, static_argnums=1)(values, op)
        assert folded.shape == (2, length // ROWS)
        np.testing.assert_allclose(folded, oracle(expected, axis=1), atol=1e-5)


@pytest.mark.parametrize("length", [1, 15, 17, 47])
def test_lengths_that_are_not_multiples_are_rejected(length: int) -> None:
    with pytest.raises(TypeError):
        fold(jnp.zeros((2, length)), jnp.add)


FEW = (*range(1, 21), 24, 32, 33, 40, 48, 64, 66, 80, 96, 112, 127, 128, 130)
"""Lengths that can be halved 0 to 4 times, to odd and to even ones."""


@pytest.fixture(scope="module", params=[FEW, pytest.param(range(1, 131), marks=pytest.mark.slow)], ids=["few", "all"])
def argmaxes(request: pytest.FixtureRequest) -> Callable[[np.ndarray], dict[int, np.ndarray]]:
    """Map a length to `argmax` over that many first entries of each row of an [8, 130] array, compiled together."""
    compiled = jax.jit(lambda values: {length: argmax(values[:, :length]) for length in request.param})
    return lambda values: {length: np.asarray(index) for length, index in compiled(values).items()}


def test_argmax_of_any_length(argmaxes: Callable[[np.ndarray], dict[int, np.ndarray]]) -> None:
    values = numbers(8, 130)
    for length, index in argmaxes(values).items():
        assert index.shape == (8,) and index.dtype == np.int32
        np.testing.assert_array_equal(index, values[:, :length].argmax(axis=1))


def test_argmax_in_every_place(argmaxes: Callable[[np.ndarray], dict[int, np.ndarray]]) -> None:
    for start in range(0, 123, 8):
        values, place = np.full((8, 130), -np.inf, np.float32), start + np.arange(8)
        values[np.arange(8), place] = -3.0
        for length, index in argmaxes(values).items():
            np.testing.assert_array_equal(index[place < length], place[place < length])
            assert (0 <= index).all() and (index < length).all()


def test_argmax_of_ties_is_one_of_them(argmaxes: Callable[[np.ndarray], dict[int, np.ndarray]]) -> None:
    values = np.random.default_rng(1).integers(0, 3, (8, 130)).astype(np.float32)
    values[0], values[1] = 0, -np.inf
    for length, index in argmaxes(values).items():
        assert (0 <= index).all() and (index < length).all()
        np.testing.assert_array_equal(values[np.arange(8), index], values[:, :length].max(axis=1))


def test_argmax_under_vmap_and_without_other_axes() -> None:
    values = numbers(2, 3, 66)
    compiled = jax.jit(lambda x: (argmax(x), jax.vmap(argmax)(x), jax.vmap(jax.vmap(argmax))(x), argmax(x[1, 2])))
    *indices, last = compiled(values)
    for index in indices:
        np.testing.assert_array_equal(index, values.argmax(axis=-1))
    assert last.shape == () and int(last) == values[1, 2].argmax()
    assert int(argmax(jnp.asarray([3.0, 5.0, 4.0]))) == 1  # not compiled
