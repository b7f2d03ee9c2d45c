"""The rules of outlier removal against loops over pixels and distances, and grids labelled by SciPy."""

from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.distance import cdist

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.outliers import flying_pixels, remove_outliers

CAMERA = Intrinsics(611.3, 620.0, 10.0, 8.0)

# Flying pixels


def frame_of(depth: np.ndarray, labels: np.ndarray) -> RGBDFrame:
    return RGBDFrame(np.zeros((*labels.shape, 3), np.uint8), depth, labels, CAMERA)


def flying_by_loop(depth: np.ndarray, labels: np.ndarray, label: int) -> np.ndarray:
    """Return the flying pixels of an instance, [H, W] bool, with a loop; depth in millimetres."""
    height, width = labels.shape
    flying = np.zeros(labels.shape, bool)
    for row in range(height):
        for column in range(width):
            for r, c in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
                if 0 <= r < height and 0 <= c < width and labels[row, column] == labels[r, c] == label:
                    here, there = float(depth[row, column]), float(depth[r, c])
                    if there > 0 and here - there > 15 * here / CAMERA.fx:
                        flying[row, column] = True
    return flying


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (17, 23)])
@pytest.mark.parametrize("spread", [15, 60, 900])
def test_flying_pixels_against_a_loop(shape: tuple[int, int], spread: int) -> None:
    """Tests a noisy plane with missing depth and several instances that touch."""
    rng = np.random.default_rng(spread)
    depth = (900 + rng.integers(0, spread, shape)).astype(np.uint16)
    depth[rng.random(shape) < 0.1] = 0
    labels = rng.choice([0, 2, 5], shape, p=[0.1, 0.7, 0.2]).astype(np.uint8)
    frame = frame_of(depth, labels)
    for label, pixels in frame.instance_pixels.items():
        flying = flying_pixels(frame, pixels)
        assert flying.shape == pixels.shape and flying.dtype == bool
        np.testing.assert_array_equal(flying, flying_by_loop(depth, labels, label).ravel()[pixels])


# Isolated points and connected components


def kept_by_loops(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """Apply the neighbour rule (30 neighbours within 16 mm on average), and keep large components of a 1 cm grid."""
    points = points.astype(np.float64)
    nearest = np.sort(cdist(points, points), axis=1)[:, 1:31]
    among = np.array([len(row) == 30 and float(np.mean(row)) <= 0.016 for row in nearest])
    relaxed = among.sum() < len(points) / 2
    index = np.arange(len(points)) if relaxed else np.flatnonzero(among)
    cells = np.floor(points[index] / 0.01).astype(int)
    cells -= cells.min(axis=0)
    occupied = np.zeros(cells.max(axis=0) + 1, bool)
    occupied[tuple(cells.T)] = True
    piece = ndimage.label(occupied, structure=np.ones((3, 3, 3)))[0][tuple(cells.T)]
    largest = max(int((piece == k).sum()) for k in set(piece.tolist()))
    return index[[int((piece == k).sum()) * 10 >= largest for k in piece]], bool(relaxed)


def assert_equals_loops(points: np.ndarray) -> None:
    kept, relaxed = remove_outliers(points)
    expected, expected_relaxed = kept_by_loops(points)
    np.testing.assert_array_equal(kept, expected)
    assert relaxed is expected_relaxed


@pytest.mark.parametrize("count", [1, 2, 30, 31, 32, 101, 400])
@pytest.mark.parametrize("side", [0.01, 0.03, 0.06, 0.2])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_outliers_against_loops(count: int, side: float, kind: Any) -> None:
    """Tests clouds that are dense in the middle, with isolated points around."""
    rng = np.random.default_rng(count)
    points = (rng.normal(size=(count, 3)) * side * rng.uniform(0.1, 1, (count, 1))).astype(kind)
    before = points.copy()
    assert_equals_loops(points)
    np.testing.assert_array_equal(points, before)


@pytest.mark.parametrize("share", [0.02, 0.06, 0.1, 0.15, 0.3, 1.0])
@pytest.mark.parametrize("depth", [1, 4, 10])
def test_clouds_on_the_voxel_grid_against_loops(share: float, depth: int) -> None:
    """Some of the 3 mm cubes of a thin or thick slab hold one point."""
    rng = np.random.default_rng(depth)
    cubes = np.argwhere(rng.random((20, 20, depth)) < share)
    cubes = cubes[rng.permutation(len(cubes))[:1200]]
    points = (cubes + rng.random(cubes.shape)) * 0.003 - [0.03, 0.01, -0.8]
    assert_equals_loops(points)


def grid(rows: int, columns: int, spacing: float = 0.003) -> np.ndarray:
    """Return a plane of rows x columns points with a corner at the origin."""
    row, column = np.mgrid[:rows, :columns]
    return np.stack([column, row, np.zeros_like(row)], axis=-1).reshape(-1, 3) * spacing


@pytest.mark.parametrize(("size", "stays"), [(99, False), (100, True), (101, True)])
def test_pieces_stay_from_a_tenth_of_the_largest(size: int, stays: bool) -> None:
    plane = grid(25, 40) + 0.001
    piece = grid(11, 10)[:size] + [0.2, 0, 0.001]
    kept, relaxed = remove_outliers(np.concatenate([plane, piece]))
    assert not relaxed
    np.testing.assert_array_equal(kept, np.arange(1000 + size * stays))


@pytest.mark.parametrize(("strays", "relaxed"), [(1599, False), (1600, False), (1601, True)])
def test_the_neighbour_rule_is_skipped_if_it_drops_most(strays: int, relaxed: bool) -> None:
    plane = grid(40, 40)
    scattered = grid(41, 41, 0.03)[:strays] + [0, 0, 1]
    kept, skipped = remove_outliers(np.concatenate([plane, scattered]))
    assert skipped is relaxed
    np.testing.assert_array_equal(kept, np.arange(1600))  # each scattered point is a component


def test_no_points() -> None:
    kept, relaxed = remove_outliers(np.zeros((0, 3), np.float32))
    assert len(kept) == 0 and not relaxed
