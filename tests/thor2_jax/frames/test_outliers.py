"""The voxel grid against cubes by NumPy, and outlier removal against loops and components by SciPy."""

import math
import re
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.outliers import (
    downsample_to_fit,
    fit_plane,
    flying_pixels,
    remove_outliers,
    strip_pixels,
    voxel_downsample,
)

CAMERA = Intrinsics(611.3, 620.0, 10.0, 8.0)

# The voxel grid


def means_by_cube(points: np.ndarray, values: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of points and values in each cube, in lexicographic order and float64."""
    points, values = points.astype(np.float64), values.astype(np.float64)
    cubes = np.floor((points - (points.min(axis=0) - size / 2)) / size)
    members = [(cubes == cube).all(axis=1) for cube in np.unique(cubes, axis=0)]
    return np.array([points[m].mean(axis=0) for m in members]), np.array([values[m].mean(axis=0) for m in members])


@pytest.mark.parametrize("count", [1, 2, 7, 501])
@pytest.mark.parametrize("size", [0.0001, 0.003, 0.05, 10.0])
def test_means_of_cubes(count: int, size: float) -> None:
    rng = np.random.default_rng(count)
    points = rng.uniform(-0.1, 0.2, (count, 3))
    points[1::2] = points[1::2].round(1)  # many of these are equal
    colors = rng.uniform(0, 1, (count, 3))
    before = points.copy(), colors.copy()
    means = voxel_downsample(points, colors, size)
    np.testing.assert_array_equal((points, colors), before)
    for mean, expected in zip(means, means_by_cube(points, colors, size), strict=True):
        np.testing.assert_allclose(mean, expected, rtol=0, atol=1e-15)


def test_types_are_kept_and_colors_rounded_halves_up() -> None:
    points = np.array([[0, 0, 0], [0.001, 0, 0], [1, 0, 0]], np.float32)
    colors = np.array([[0, 10, 255], [1, 11, 254], [7, 8, 9]], np.uint8)  # sums that exceed 8 bits
    for array, none in zip((points, colors), voxel_downsample(points[:0], colors[:0], 0.01), strict=True):
        np.testing.assert_array_equal(none, array[:0], strict=True)
    mean_points, mean_colors = voxel_downsample(points, colors, 0.01)
    assert mean_points.dtype == np.float32 and mean_colors.dtype == np.uint8
    np.testing.assert_allclose(mean_points, [[0.0005, 0, 0], [1, 0, 0]], atol=1e-7)
    np.testing.assert_array_equal(mean_colors, [[1, 11, 255], [7, 8, 9]])


@pytest.mark.parametrize("turns", range(3))
def test_as_many_cubes_as_numbers_of_63_bits(turns: int) -> None:
    """A grid of 2^61 cubes is accepted, and one of 2^62 is refused; the axes differ in length."""
    span = np.roll(np.array([2.0**10, 2.0**30, 2.0**21]) - 1, turns)
    points = np.stack([np.zeros(3), span])
    np.testing.assert_array_equal(voxel_downsample(points, points, 1.0)[0], points)
    points[1, turns] = 2**11 - 1
    assert_refused(f"^size is 1.0;.*{re.escape(str(points[1].tolist()))}", voxel_downsample, points, points, 1.0)
    assert_refused("^points has rows", voxel_downsample, points * [[1], [np.nan]], points, 1.0)


@pytest.mark.parametrize(("side", "doublings"), [(20, 0), (21, 1), (50, 2)])
def test_clouds_beyond_the_largest_bucket_get_larger_voxels(side: int, doublings: int) -> None:
    points = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float64)
    colors = np.zeros((len(points), 3))
    downsampled, _ = downsample_to_fit(points, colors, 1.0)
    expected, _ = voxel_downsample(points, colors, 2.0**doublings)
    np.testing.assert_array_equal(downsampled, expected)
    assert len(downsampled) <= 8192


# Flying pixels


def flying_by_loop(depth: np.ndarray, labels: np.ndarray, label: int) -> np.ndarray:
    """Return the flying pixels of an instance, [H, W] bool, with a loop; depth in millimetres."""
    labels, depth = np.pad(labels, 1), np.pad(depth.astype(float), 1)
    flying = np.zeros(labels.shape, bool)
    for row, column in np.argwhere(labels == label):
        here = depth[row, column]
        for beside in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if labels[beside] == label and depth[beside] > 0 and here - depth[beside] > 15 * here / CAMERA.fx:
                flying[row, column] = True
    return flying[1:-1, 1:-1]


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (17, 23)])
@pytest.mark.parametrize("spread", [15, 60, 900])
def test_flying_pixels_against_a_loop(shape: tuple[int, int], spread: int) -> None:
    """Tests a noisy plane with missing depth and several instances that touch."""
    rng = np.random.default_rng(spread)
    depth = (900 + rng.integers(0, spread, shape)).astype(np.uint16)
    depth[rng.random(shape) < 0.1] = 0
    labels = rng.choice([0, 2, 5], shape, p=[0.1, 0.7, 0.2]).astype(np.uint8)
    frame = RGBDFrame(np.zeros((*shape, 3), np.uint8), depth, labels, CAMERA)
    for label, pixels in frame.instance_pixels.items():
        expected = flying_by_loop(depth, labels, label).ravel()[pixels]
        np.testing.assert_array_equal(flying_pixels(frame, pixels), expected, strict=True)


# Strips of background


def strips_by_loop(depth: np.ndarray, pixels: list[tuple[int, int]], rim: np.ndarray, side: int) -> list[bool]:
    """Return whether each of `pixels` shows background, with loops over blocks of 3 x 3 cells of `side` pixels."""
    cells = [(row // side, column // side) for row, column in pixels]

    def adjacent(here: tuple[int, int]) -> list[int]:
        return [k for k, cell in enumerate(cells) if max(abs(cell[0] - here[0]), abs(cell[1] - here[1])) <= 1]

    limits = {}
    for cell in set(cells):
        pairs = [(depth[pixels[k - 1]], depth[pixels[k]]) for k in adjacent(cell) if k > 0]
        nearest = min([max(pair) / 1000 for pair in pairs if min(pair) >= 260 and max(pair) <= 2500], default=np.inf)
        limits[cell] = max(nearest + 0.05, nearest * (1 + 3 * 2 * side / CAMERA.fx))
    far = [depth[pixel] / 1000 > limits[cell] for pixel, cell in zip(pixels, cells, strict=True)]
    return [f and any(far[k] and rim[k] for k in adjacent(cell)) for f, cell in zip(far, cells, strict=True)]


@pytest.mark.parametrize(("distance", "width", "side"), [(600, 58, 6), (1800, 58, 6), (600, 1300, 13)])
def test_strips_of_background_against_loops(distance: int, width: int, side: int) -> None:
    """The mask of a slope has a hole, the background above, missing depth, and far pixels away from its contour."""
    rng = np.random.default_rng(distance)
    depth = distance + np.arange(58) * 6 + rng.integers(0, 4, (45, 58))
    depth[:9] += 300
    depth[22:28, 30:36] += 200
    depth[40, 50] -= 300  # a wrong pixel in front of the others
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[20, 30:33] = 50  # no camera measures so near
    labels = np.full(depth.shape, 7, np.uint8)
    labels[:5], labels[:, 54:], labels[30:40, 20:23] = 0, 3, 0
    depth[labels == 0] = 0  # so that no table is found
    depth, labels = (np.pad(image, ((0, 0), (0, width - 58))) for image in (depth, labels))
    frame = RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth.astype(np.uint16), labels, CAMERA)
    rim = (labels == 7) & ndimage.binary_dilation(labels != 7)
    for label, part in ((7, labels == 7), (3, labels == 3)):
        pixels = frame.instance_pixels[label]
        strips = strip_pixels(frame, pixels, frame.points(pixels), rim[part])
        expected = strips_by_loop(depth, list(map(tuple, np.argwhere(part).tolist())), rim[part], side)
        np.testing.assert_array_equal(strips, expected, strict=True)
    shown = np.zeros(depth.shape, bool)
    pixels = frame.instance_pixels[7]
    shown.ravel()[pixels] = strip_pixels(frame, pixels, frame.points(pixels), rim[labels == 7])
    assert shown[5:9, :54][depth[5:9, :54] > 0].mean() > 0.9
    assert shown[22:28, 30:36].any() == (side == 13)  # only larger cells reach from a contour with background
    assert shown[20:, 46:].any() == (distance == 600)  # far away, pixels are wider, so that the slope is flatter


def test_planes_against_a_singular_value_decomposition() -> None:
    """Three of ten points lie anywhere, the others within a millimetre of a plane."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (1000, 3))
    points[300:, 2] = 0.3 * points[300:, 0] - 0.2 * points[300:, 1] + 2 + rng.uniform(-0.001, 0.001, 700)
    normal, offset, share = fit_plane(points, 0.005)
    center = points[300:].mean(axis=0)
    expected = np.linalg.svd(points[300:] - center)[2][2]
    assert abs(normal @ expected) > 1 - 1e-6 and abs(normal @ center - offset) < 1e-4 and 0.7 <= share < 0.71
    for line in (points[:2], np.outer(np.arange(9.0), [1, 2, 3])):
        assert fit_plane(line, 0.005)[1:] == (math.inf, 0)


# Isolated points and connected components


def kept_by_loops(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """Apply the neighbour rule (30 neighbours within 16 mm on average), and keep large components of a 1 cm grid."""
    points = points.astype(np.float64)
    if not len(points):
        return np.arange(0), False
    nearest = np.sort(cdist(points, points), axis=1)[:, 1:31]
    among = np.array([len(row) == 30 and float(np.mean(row)) <= 0.016 for row in nearest])
    relaxed = among.sum() < len(points) / 2
    index = np.arange(len(points)) if relaxed else np.flatnonzero(among)
    cells = np.floor(points[index] / 0.01)
    _, piece = connected_components(cdist(cells, cells, "chebyshev") <= 1)
    size = np.bincount(piece)[piece]
    return index[10 * size >= size.max()], bool(relaxed)


@pytest.mark.parametrize("count", [0, 1, 2, 30, 31, 32, 101, 400])
@pytest.mark.parametrize("side", [0.01, 0.02, 0.03, 0.06, 0.2])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_outliers_against_loops(count: int, side: float, kind: Any) -> None:
    """Tests clouds that are dense in the middle, with isolated points around."""
    rng = np.random.default_rng(count)
    points = (rng.normal(size=(count, 3)) * side * rng.uniform(0.1, 1, (count, 1))).astype(kind)
    before = points.copy()
    np.testing.assert_equal(remove_outliers(points), kept_by_loops(points))
    np.testing.assert_array_equal(points, before)
