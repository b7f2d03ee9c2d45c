"""The voxel grid against a dictionary of cubes."""

import math
import re

import numpy as np
import pytest

from thor2_jax.errors import InputError
from thor2_jax.frames.voxel_grid import downsample_to_fit, voxel_downsample


def by_dictionary(points: np.ndarray, values: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of points and values in each cube, in lexicographic order and float64."""
    points, values = points.astype(np.float64), values.astype(np.float64)
    low = points.min(axis=0) - size / 2
    cubes: dict[tuple[int, ...], list[int]] = {}
    for i, point in enumerate(points):
        cubes.setdefault(tuple(math.floor((point[k] - low[k]) / size) for k in range(3)), []).append(i)
    members = [cubes[key] for key in sorted(cubes)]
    return np.array([points[m].mean(axis=0) for m in members]), np.array([values[m].mean(axis=0) for m in members])


@pytest.mark.parametrize("count", [1, 2, 7, 501])
@pytest.mark.parametrize("size", [0.003, 0.05, 10.0])
def test_means_of_cubes(count: int, size: float) -> None:
    rng = np.random.default_rng(count)
    points = rng.uniform(-0.1, 0.2, (count, 3))
    colors = rng.uniform(0, 1, (count, 3))
    mean_points, mean_colors = voxel_downsample(points, colors, size)
    expected_points, expected_colors = by_dictionary(points, colors, size)
    np.testing.assert_allclose(mean_points, expected_points, rtol=0, atol=1e-15)
    np.testing.assert_allclose(mean_colors, expected_colors, rtol=0, atol=1e-15)


def test_several_points_share_a_cube() -> None:
    """Otherwise the comparison above would also pass for the identity."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 0.1, (500, 3))
    assert 1 < len(voxel_downsample(points, points, 0.05)[0]) < 30
    assert len(voxel_downsample(points, points, 10.0)[0]) == 1


def test_types_are_kept_and_colors_rounded_halves_up() -> None:
    points = np.array([[0, 0, 0], [0.001, 0, 0], [1, 0, 0]], np.float32)
    colors = np.array([[0, 10, 255], [1, 11, 254], [7, 8, 9]], np.uint8)
    mean_points, mean_colors = voxel_downsample(points, colors, 0.01)
    assert mean_points.dtype == np.float32 and mean_colors.dtype == np.uint8
    np.testing.assert_allclose(mean_points, [[0.0005, 0, 0], [1, 0, 0]], atol=1e-7)
    np.testing.assert_array_equal(mean_colors, [[1, 11, 255], [7, 8, 9]])


def test_bright_colors_do_not_wrap() -> None:
    points = np.zeros((1001, 3), np.float32)
    colors = voxel_downsample(points, np.full((1001, 3), 255, np.uint8), 0.01)[1]
    np.testing.assert_array_equal(colors, [[255, 255, 255]])


def test_the_grid_starts_half_a_cube_below_the_cloud() -> None:
    points = np.array([[5, 5, 5], [5.049, 5, 5], [5.051, 5, 5]])
    assert len(voxel_downsample(points, points, 0.1)[0]) == 2
    np.testing.assert_allclose(voxel_downsample(points, points, 0.1)[0][:, 0], [5.0245, 5.051])


def test_the_order_of_points_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    points, colors = rng.uniform(0, 1, (200, 3)), rng.integers(0, 256, (200, 3), dtype=np.uint8)
    order = rng.permutation(200)
    for one, other in zip(
        voxel_downsample(points, colors, 0.2), voxel_downsample(points[order], colors[order], 0.2), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-14)


def test_empty_cloud() -> None:
    points, colors = voxel_downsample(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 0.01)
    assert points.shape == colors.shape == (0, 3)
    assert points.dtype == np.float32 and colors.dtype == np.uint8


def test_arguments_are_left_alone() -> None:
    points, colors = np.random.default_rng(1).uniform(size=(2, 50, 3))
    before = points.copy(), colors.copy()
    voxel_downsample(points, colors, 0.3)
    np.testing.assert_array_equal(points, before[0])
    np.testing.assert_array_equal(colors, before[1])


@pytest.mark.parametrize("size", [0, -0.01, float("nan")])
def test_sizes_that_are_not_positive(size: float) -> None:
    with pytest.raises(InputError, match="^size is "):
        voxel_downsample(np.zeros((2, 3)), np.zeros((2, 3)), size)


@pytest.mark.parametrize("turns", range(3))
def test_as_many_cubes_as_numbers_of_63_bits(turns: int) -> None:
    """A grid of 2^61 cubes is accepted, and one of 2^62 is refused; the axes differ in length."""
    span = np.roll(np.array([2.0**10, 2.0**30, 2.0**21]) - 1, turns)
    points = np.stack([np.zeros(3), span])
    np.testing.assert_array_equal(voxel_downsample(points, points, 1.0)[0], points)
    points[1, turns] = 2**11 - 1
    with pytest.raises(InputError, match=f"^size is 1.0;.*{re.escape(str(points[1].tolist()))}"):
        voxel_downsample(points, points, 1.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite(value: float) -> None:
    points = np.zeros((4, 3))
    points[1, 2] = points[3, 0] = value
    with pytest.raises(InputError, match=r"^points has 2 "):
        voxel_downsample(points, np.zeros((4, 3)), 0.01)


@pytest.mark.parametrize(("points", "colors"), [((4, 2), (4, 3)), ((4, 3), (3, 3)), ((12,), (4, 3)), ((4, 3), (4,))])
def test_shapes_that_do_not_fit(points: tuple[int, ...], colors: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="shapes"):
        voxel_downsample(np.zeros(points), np.zeros(colors), 0.01)


@pytest.mark.parametrize(("side", "doublings"), [(20, 0), (21, 1), (50, 2)])
def test_clouds_beyond_the_largest_bucket_get_larger_voxels(side: int, doublings: int) -> None:
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)
    colors = np.zeros((len(points), 3))
    downsampled, _ = downsample_to_fit(points, colors, 1.0)
    expected, _ = voxel_downsample(points, colors, 2.0**doublings)
    np.testing.assert_array_equal(downsampled, expected)
    assert len(downsampled) <= 8192
