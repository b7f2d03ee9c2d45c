"""View normalization: a rigid motion into a box that is nearly as small as that of an exhaustive search (trimesh)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from refusals import assert_refused
from scipy.spatial.transform import Rotation
from small_clouds import DEGENERATE

import thor2_jax as thor2
from thor2_jax.descriptor.view_normalization import _minimum_area_angle
from thor2_jax.types import matmul

CONFIG = thor2.DescriptorConfig()

# These tests share three shapes, [1, 512], [1, 1024] and [4, 512], since compilation dominates their time.


def pack(*clouds: np.ndarray, **options: object) -> thor2.PointClouds:
    return thor2.PointClouds.pack([(points, np.full(points.shape, 0.5)) for points in clouds], **options)


def shapes() -> list[np.ndarray]:
    """Return randomly rotated clouds like those of objects, half a metre away: flat, long, round and partial."""
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
        clouds.append(0.1 * points @ Rotation.random(random_state=k).as_matrix().T + [0.02, -0.05, 0.5])
    return clouds


SHAPES = shapes()
SOME = pack(SHAPES[0], np.zeros((0, 3)), *SHAPES[1:3])
"""Four clouds, one of which is empty."""


def test_clouds_move_rigidly_with_the_camera_into_small_boxes() -> None:
    """Volumes are compared with those of an exhaustive search."""
    ratios = []
    for seed, points in enumerate(SHAPES):
        camera = np.random.default_rng(seed).normal(size=3)
        normal = thor2.view_normalize(pack(points, camera=camera), CONFIG)
        before, after = 2.5 * points, np.asarray(normal.points[0, : len(points)], np.float64)
        rotation, _ = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))
        shift = after.mean(axis=0) - rotation.apply(before.mean(axis=0))
        np.testing.assert_allclose(after, rotation.apply(before) + shift, rtol=0, atol=2e-6)
        np.testing.assert_allclose(normal.camera[0], rotation.apply(2.5 * camera) + shift, atol=1e-5)
        sides = after.max(axis=0)
        np.testing.assert_array_equal(after.min(axis=0), 0)
        assert sides[0] >= sides[1] >= sides[2]
        assert float(normal.camera[0, 2]) <= sides[2] / 2  # camera side
        assert after[:, 0].mean() <= sides[0] / 2  # sign rule
        ratios.append(np.prod(sides) / np.prod(trimesh.bounds.oriented_bounds(before)[1]))
    assert np.median(ratios) <= 1.003
    assert max(ratios) <= 1.015  # 1.020 with fewer sweeps, 1.023 from the principal axes alone


AMBIGUOUS = {
    **{name: points for name, points in DEGENERATE.items() if len(points)},
    "three points": np.array([[0, 0, 0.5], [0.1, 0, 0.5], [0, 0.2, 0.5]]),
    "ball": np.asarray(trimesh.creation.icosphere(2, radius=0.1).vertices) + [0, 0, 0.6],
}


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_degenerate_clouds_move_rigidly_too(name: str) -> None:
    points = AMBIGUOUS[name]
    after = np.asarray(thor2.view_normalize(pack(points), CONFIG).points[0, : len(points)], np.float64)
    between = np.linalg.norm(points[:, None] - points, axis=-1) * 2.5
    np.testing.assert_allclose(np.linalg.norm(after[:, None] - after, axis=-1), between, atol=3e-6)
    assert (np.diff(after.max(axis=0)) <= 2e-6).all()
    rank = np.linalg.matrix_rank(points - points.mean(axis=0), tol=1e-6)
    np.testing.assert_allclose(after.max(axis=0)[rank:], 0, atol=1e-5)


@pytest.mark.parametrize("height", [0.03, 0.045, 0.055, 0.07])
@pytest.mark.parametrize("heavy", ["below", "above"])
def test_the_camera_side_is_relative_to_the_middle_of_the_box(height: float, heavy: str) -> None:
    """The camera is beside a slab whose mean lies near one of its large faces."""
    rng = np.random.default_rng(0)
    points = rng.random((450, 3)) * [0.4, 0.3, 0.1]
    points[:400, 2] = 0 if heavy == "below" else 0.1
    normal = thor2.view_normalize(pack(points, camera=np.array([1, 0.15, height])), CONFIG)
    assert float(normal.camera[0, 2]) <= float(normal.points[0, : len(points), 2].max()) / 2


@pytest.mark.parametrize("alpha", [np.pi / 4, -0.3])
def test_turn_is_the_rotation_matrix_about_y_by_minus_alpha(alpha: float) -> None:
    config = dataclasses.replace(CONFIG, alpha=float(alpha))
    normal = thor2.view_normalize(SOME, CONFIG)
    aligned = thor2.turn(normal, config)
    rotation = Rotation.from_euler("y", -alpha)
    for i in (0, 2, 3):
        expected = rotation.apply(normal.unpack()[i][0])
        low = expected.min(axis=0)
        np.testing.assert_allclose(aligned.unpack()[i][0], expected - low, atol=1e-6)
        np.testing.assert_allclose(aligned.camera[i], rotation.apply(normal.camera[i]) - low, atol=1e-5)
    np.testing.assert_allclose(thor2.align(SOME, config).points, aligned.points, atol=1e-6)  # one rotation


def test_large_batches_of_small_rotations_are_exact() -> None:
    """Jax 0.10.2, which is excluded, miscompiles this kernel beyond 32,768 rows on CPUs (jax issue 39103)."""
    matrix = jnp.asarray(Rotation.from_euler("z", 0.0).as_matrix(), jnp.float32)
    rows = jnp.zeros((40_000, 3)).at[:, 0].set(jnp.arange(40_000.0))
    kernel = jax.vmap(lambda row: jnp.sum(matmul(matrix, row) ** 2))
    expected = np.arange(40_000, dtype=np.float64) ** 2
    np.testing.assert_allclose(jax.jit(kernel)(rows), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.jit(kernel)(rows[:32_769])[-1], 32_768.0**2, rtol=0)


@pytest.mark.parametrize("axes", ["", "x", "y", "xy", "xyz"])
def test_mirror_keeps_the_box(axes: str) -> None:
    normal = thor2.view_normalize(SOME, CONFIG)
    mirrored = thor2.mirror(normal, axes)
    before, after = (np.vstack([each.unpack()[2][0], each.camera[2]]) for each in (normal, mirrored))
    for k, letter in enumerate("xyz"):
        expected = before[:-1, k].max() - before[:, k] if letter in axes else before[:, k]
        np.testing.assert_array_equal(after[:, k], expected)
    np.testing.assert_array_equal(np.asarray(mirrored.points)[~np.asarray(normal.mask)], 0)
    np.testing.assert_array_equal(mirrored.mask, normal.mask)
    assert_refused(f"axes is '{axes}w'", thor2.mirror, normal, f"{axes}w")


def test_a_mirrored_projection_has_the_opposite_angle() -> None:
    """The signs of the initial frame of the search therefore do not matter."""
    minimum_area_angle = jax.jit(_minimum_area_angle)
    for seed in range(5):
        xy = np.random.default_rng(seed).normal(size=(2, 80)).astype(np.float32)
        angle = float(minimum_area_angle(xy))
        assert 0 < abs(angle) < np.pi / 4
        assert float(minimum_area_angle(xy * np.array([[1], [-1]], np.float32))) == pytest.approx(-angle, abs=1e-6)
