"""The voxel grid against a dictionary of cubes."""

import math
import re

import numpy as np
import pytest
from refusals import assert_refused

from thor2_jax.frames.outliers import downsample_to_fit, voxel_downsample


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
    before = points.copy(), colors.copy()
    mean_points, mean_colors = voxel_downsample(points, colors, size)
    assert size < 10 or len(mean_points) == 1
    np.testing.assert_array_equal((points, colors), before)
    expected_points, expected_colors = by_dictionary(points, colors, size)
    np.testing.assert_allclose(mean_points, expected_points, rtol=0, atol=1e-15)
    np.testing.assert_allclose(mean_colors, expected_colors, rtol=0, atol=1e-15)


def test_types_are_kept_and_colors_rounded_halves_up() -> None:
    points = np.array([[0, 0, 0], [0.001, 0, 0], [1, 0, 0]], np.float32)
    colors = np.array([[0, 10, 255], [1, 11, 254], [7, 8, 9]], np.uint8)  # sums that exceed 8 bits
    mean_points, mean_colors = voxel_downsample(points, colors, 0.01)
    assert mean_points.dtype == np.float32 and mean_colors.dtype == np.uint8
    np.testing.assert_allclose(mean_points, [[0.0005, 0, 0], [1, 0, 0]], atol=1e-7)
    np.testing.assert_array_equal(mean_colors, [[1, 11, 255], [7, 8, 9]])


def test_empty_cloud() -> None:
    points, colors = voxel_downsample(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 0.01)
    assert points.shape == colors.shape == (0, 3)
    assert points.dtype == np.float32 and colors.dtype == np.uint8


def test_points_that_are_not_finite_are_refused() -> None:
    points = np.array([[0, 0, math.nan], [0, 0, 0]])
    assert_refused("^points has rows", voxel_downsample, points, np.zeros((2, 3)), 0.01)


@pytest.mark.parametrize("turns", range(3))
def test_as_many_cubes_as_numbers_of_63_bits(turns: int) -> None:
    """A grid of 2^61 cubes is accepted, and one of 2^62 is refused; the axes differ in length."""
    span = np.roll(np.array([2.0**10, 2.0**30, 2.0**21]) - 1, turns)
    points = np.stack([np.zeros(3), span])
    np.testing.assert_array_equal(voxel_downsample(points, points, 1.0)[0], points)
    points[1, turns] = 2**11 - 1
    assert_refused(f"^size is 1.0;.*{re.escape(str(points[1].tolist()))}", voxel_downsample, points, points, 1.0)


@pytest.mark.parametrize(("side", "doublings"), [(20, 0), (21, 1), (50, 2)])
def test_clouds_beyond_the_largest_bucket_get_larger_voxels(side: int, doublings: int) -> None:
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)
    colors = np.zeros((len(points), 3))
    downsampled, _ = downsample_to_fit(points, colors, 1.0)
    expected, _ = voxel_downsample(points, colors, 2.0**doublings)
    np.testing.assert_array_equal(downsampled, expected)
    assert len(downsampled) <= 8192
