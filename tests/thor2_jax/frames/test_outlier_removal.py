"""The rules of outlier removal against loops over pixels and distances, and grids labelled by SciPy."""

from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.distance import cdist

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.outlier_removal import flying_pixels, remove_outliers

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


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize(("slope", "flies"), [(14.5, False), (15.5, True)])
def test_the_steepest_slope(slope: float, flies: bool, turns: int) -> None:
    """Depth grows by `slope` pixel widths per pixel; all pixels except the nearest row or column fly, or none does."""
    depth = np.broadcast_to(0.6 * (1 - slope / CAMERA.fx) ** -np.arange(12.0), (7, 12))
    depth = np.rot90(depth, turns).astype(np.float32).copy()
    frame = frame_of(depth, np.ones(depth.shape, np.uint8))
    flying = flying_pixels(frame, np.arange(depth.size))
    np.testing.assert_array_equal(flying, flies & (depth.ravel() > depth.min() * 1.001))


def test_other_instances_make_no_flying_pixels() -> None:
    labels = np.zeros((9, 20), np.uint8)
    labels[:, 5:10], labels[:, 10:15] = 1, 2
    frame = frame_of(np.where(labels == 1, 1200, 700).astype(np.uint16), labels)
    for pixels in frame.instance_pixels.values():
        assert not flying_pixels(frame, pixels).any()


def test_the_image_does_not_wrap_around() -> None:
    """The last pixel of a row and the first of the next are adjacent in memory, but not neighbours."""
    depth = np.array([[1000, 1000, 1000], [500, 500, 500]], np.uint16)
    labels = np.array([[0, 0, 1], [1, 0, 0]], np.uint8)
    frame = frame_of(depth, labels)
    assert not flying_pixels(frame, frame.instance_pixels[1]).any()


def test_no_pixels() -> None:
    frame = frame_of(np.full((3, 3), 800, np.uint16), np.zeros((3, 3), np.uint8))
    assert flying_pixels(frame, np.zeros(0, np.intp)).shape == (0,)


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


def assert_equals_loops(points: np.ndarray) -> int:
    """Assert that outlier removal equals the loops, and return the number of points that are kept."""
    kept, relaxed = remove_outliers(points)
    expected, expected_relaxed = kept_by_loops(points)
    np.testing.assert_array_equal(kept, expected)
    assert relaxed is expected_relaxed
    return len(kept)


@pytest.mark.parametrize("count", [1, 2, 30, 31, 32, 101, 400])
@pytest.mark.parametrize("side", [0.01, 0.03, 0.06, 0.2])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_outliers_against_loops(count: int, side: float, kind: Any) -> None:
    """Tests clouds that are dense in the middle, with isolated points around."""
    rng = np.random.default_rng(count)
    points = (rng.normal(size=(count, 3)) * side * rng.uniform(0.1, 1, (count, 1))).astype(kind)
    before = points.copy()
    assert assert_equals_loops(points) > 0
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


@pytest.mark.parametrize("start", [0.0, 0.0017, 0.0031, 0.0052])
def test_a_point_that_leaves_a_block_along_its_diagonal(start: float) -> None:
    """31 points in adjacent cells are not enough if they are too far away."""
    block = np.argwhere(np.ones((4, 4, 4))) * 0.003
    away = np.arange(0.001, 0.02, 0.0005)
    counts = [assert_equals_loops(np.concatenate([block, [[-d] * 3]]) + start) for d in away]
    assert counts[0] == 65 and counts[-1] == 64


@pytest.mark.parametrize(("size", "stays"), [(99, False), (100, True), (101, True)])
def test_pieces_stay_from_a_tenth_of_the_largest(size: int, stays: bool) -> None:
    plane = grid(25, 40) + 0.001
    piece = grid(11, 10)[:size] + [0.2, 0, 0.001]
    kept, relaxed = remove_outliers(np.concatenate([plane, piece]))
    assert not relaxed
    np.testing.assert_array_equal(kept, np.arange(1000 + size * stays))


@pytest.mark.parametrize(("gap", "joined"), [(0.009, True), (0.021, False)])
@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
@pytest.mark.parametrize("start", [0.0, 0.0042, -0.7])
def test_a_gap_of_two_cells_separates_components(gap: float, joined: bool, direction: list[int], start: float) -> None:
    """A small square lies beside one of the sides of a large block."""
    z, y, x = np.mgrid[:10, :10, :10]
    block = np.stack([x, y, z], axis=-1).reshape(-1, 3) * 0.003
    small = block[(block <= 0.0121).all(axis=1)][:90]
    shift = np.where(np.array(direction) < 0, -small.max(axis=0) - gap, block.max(axis=0) + gap) * np.abs(direction)
    kept, relaxed = remove_outliers(np.concatenate([block, small + shift]) + start)
    assert not relaxed
    np.testing.assert_array_equal(kept, np.arange(1090 if joined else 1000))


@pytest.mark.parametrize(("strays", "relaxed"), [(1599, False), (1600, False), (1601, True)])
def test_the_neighbour_rule_is_skipped_if_it_drops_most(strays: int, relaxed: bool) -> None:
    plane = grid(40, 40)
    scattered = grid(41, 41, 0.03)[:strays] + [0, 0, 1]
    kept, skipped = remove_outliers(np.concatenate([plane, scattered]))
    assert skipped is relaxed
    np.testing.assert_array_equal(kept, np.arange(1600))  # each scattered point is a component


@pytest.mark.parametrize("count", [1, 29, 30])
def test_clouds_of_at_most_30_points_are_kept(count: int) -> None:
    kept, relaxed = remove_outliers(grid(1, count))
    np.testing.assert_array_equal(kept, np.arange(count))
    assert relaxed


def test_points_that_coincide() -> None:
    kept, relaxed = remove_outliers(np.concatenate([np.full((64, 3), 0.7), np.full((6, 3), 0.2)]))
    np.testing.assert_array_equal(kept, np.arange(64))
    assert not relaxed


def test_no_points() -> None:
    kept, relaxed = remove_outliers(np.zeros((0, 3), np.float32))
    assert len(kept) == 0 and not relaxed
