"""Instance clouds: which pixels become points, and which points are taken for the camera's mistakes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from thor2_jax.frames import Intrinsics, RGBDFrame, backproject
from thor2_jax.instance_clouds import MIN_POINTS, InstanceCloud, instance_clouds
from thor2_jax.outlier_removal import remove_outliers
from thor2_jax.voxel_grid import voxel_downsample
from training.readers import FrameFolder, UWISOccluded

HEIGHT, WIDTH = 240, 320
CAMERA = Intrinsics(600.0, 610.0, 159.5, 119.5)


def frame_of(depth: np.ndarray, labels: np.ndarray, color: np.ndarray | None = None) -> RGBDFrame:
    if color is None:
        color = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return RGBDFrame(color, depth, labels, CAMERA)


def flat(millimetres: int = 800) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), millimetres, np.uint16)


def patch(*parts: tuple[int, int, int, int, int], kind: Any = np.uint8) -> np.ndarray:
    """Labels; each part is (label, first row, end row, first column, end column)."""
    labels = np.zeros((HEIGHT, WIDTH), kind)
    for label, top, bottom, left, right in parts:
        labels[top:bottom, left:right] = label
    return labels


def pixels_of(points: np.ndarray) -> np.ndarray:
    """(row, column) of points, unrounded."""
    x, y, z = points.T.astype(np.float64)
    return np.stack([y / z * CAMERA.fy + CAMERA.cy, x / z * CAMERA.fx + CAMERA.cx], axis=1)


def voxels_by_loop(frame: RGBDFrame, label: int) -> np.ndarray:
    """Means of an instance's points in each cube of 3 mm, pixel by pixel, float64."""
    camera, points = frame.intrinsics, []
    for row, column in zip(*np.nonzero(frame.labels == label), strict=True):
        z = float(np.float32(frame.depth[row, column] / 1000))
        if 0.26 <= z <= 2.5:
            points.append(((column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z))
    # The clouds are float32, and a point at a cube's face must fall on the same side.
    array = np.array(points, np.float32).astype(np.float64)
    cubes: dict[tuple[int, ...], list[np.ndarray]] = {}
    keys = np.floor((array - (array.min(axis=0) - 0.0015)) / 0.003).astype(int)
    for key, point in zip(map(tuple, keys), array, strict=True):
        cubes.setdefault(key, []).append(point)
    return np.array([np.mean(cubes[key], axis=0) for key in sorted(cubes)])


def only(frame: RGBDFrame) -> InstanceCloud:
    (cloud,) = instance_clouds(frame)
    return cloud


# Which pixels become points


def test_one_cloud_an_instance_in_the_order_of_labels() -> None:
    labels = patch((7, 20, 60, 30, 90), (300, 100, 160, 200, 260), (2, 180, 200, 30, 80), kind=np.uint16)
    frame = frame_of(flat(), labels)
    clouds = instance_clouds(frame)
    assert tuple(cloud.label for cloud in clouds) == frame.instances == (2, 7, 300)
    assert [cloud.n_pixels for cloud in clouds] == [20 * 50, 40 * 60, 60 * 60]
    for cloud in clouds:
        assert cloud.reason is None and not cloud.kept_by_fallback
        assert cloud.points.dtype == np.float32 and cloud.points.shape == (len(cloud.points), 3)
        assert cloud.colors.dtype == np.uint8 and cloud.colors.shape == cloud.points.shape
        nearest = np.rint(pixels_of(cloud.points)).astype(int)
        assert (labels[nearest[:, 0], nearest[:, 1]] == cloud.label).all()


def test_points_are_voxel_means_of_backprojected_pixels() -> None:
    rng = np.random.default_rng(1)
    depth = (700 + np.arange(WIDTH) // 4 + rng.integers(-2, 3, (HEIGHT, WIDTH))).astype(np.uint16)
    frame = frame_of(depth, patch((1, 50, 110, 60, 150)))
    cloud, expected = only(frame), voxels_by_loop(frame, 1)
    distance = cdist(cloud.points, expected)
    assert distance.min(axis=1).max() < 1e-6
    assert len(set(distance.argmin(axis=1))) == len(cloud.points) >= 0.9 * len(expected)


def test_colors_are_those_of_the_mask_alone() -> None:
    labels = patch((1, 50, 110, 60, 150))
    color = np.where(labels[..., None] == 1, np.array([200, 10, 30]), np.array([0, 255, 0])).astype(np.uint8)
    np.testing.assert_array_equal(np.unique(only(frame_of(flat(), labels, color)).colors, axis=0), [[200, 10, 30]])


def test_colors_stay_with_their_points() -> None:
    labels, color = patch((1, 50, 110, 60, 150)), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[..., 0] = np.arange(WIDTH) // 2
    color[..., 1] = np.arange(HEIGHT)[:, None]
    cloud = only(frame_of(flat(), labels, color))
    expected = pixels_of(cloud.points)
    assert np.abs(cloud.colors[:, 1] - expected[:, 0]).max() <= 1
    assert np.abs(cloud.colors[:, 0] - expected[:, 1] / 2).max() <= 1


@pytest.mark.parametrize(("millimetres", "used"), [(0, False), (259, False), (260, True), (2500, True), (2501, False)])
def test_depth_that_is_trusted(millimetres: int, used: bool) -> None:
    cloud = only(frame_of(flat(millimetres), patch((1, 20, 220, 20, 300))))
    assert (cloud.reason is None) == used and (len(cloud.points) > 1000) == used
    assert cloud.n_pixels == 200 * 280


def test_depth_that_is_not_finite() -> None:
    depth = flat().astype(np.float32) / 1000
    depth[:, ::2] = np.nan
    depth[::2] = np.inf
    cloud = only(frame_of(depth, patch((1, 50, 150, 60, 200))))
    assert cloud.reason is None and np.isfinite(cloud.points).all()


def test_instances_without_depth() -> None:
    cloud = only(frame_of(flat(0), patch((4, 50, 60, 60, 70))))
    assert cloud.label == 4 and cloud.n_pixels == 100 and cloud.points.shape == cloud.colors.shape == (0, 3)
    assert cloud.reason is not None and "0 points" in cloud.reason and "from 0.26 to 2.5 m" in cloud.reason


@pytest.mark.parametrize(("pixels", "usable"), [(MIN_POINTS - 1, False), (MIN_POINTS, True)])
def test_fewest_points(pixels: int, usable: bool) -> None:
    """Pixels 2.25 m away are 3.75 mm apart: a voxel each."""
    cloud = only(frame_of(flat(2250), patch((1, 5, 6, 10, 10 + pixels))))
    assert (cloud.reason is None) == usable
    if not usable:
        assert f"{pixels} points" in str(cloud.reason) and f"at least {MIN_POINTS} are needed" in str(cloud.reason)


def test_many_pixels_in_few_voxels() -> None:
    cloud = only(frame_of(flat(300), patch((1, 5, 13, 10, 20))))
    assert cloud.n_pixels == 80 and cloud.reason is not None


def test_no_instances() -> None:
    assert instance_clouds(frame_of(flat(), patch())) == []


def test_thousands_of_instances() -> None:
    labels = np.arange(HEIGHT * WIDTH, dtype=np.int32).reshape(HEIGHT, WIDTH) // 16
    clouds = instance_clouds(frame_of(flat(), labels))
    assert [cloud.label for cloud in clouds] == list(range(1, HEIGHT * WIDTH // 16))
    assert all(cloud.n_pixels == 16 and cloud.reason is not None for cloud in clouds)


# Which points are dropped


def test_flying_pixels_are_dropped_and_the_object_kept() -> None:
    """A dome before a wall; pixels along the mask's edge lie somewhere between the two."""
    rng = np.random.default_rng(2)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(rows - 120, columns - 160)
    labels = (distance <= 62).astype(np.uint8)
    depth = np.where(distance <= 60, 850 - np.sqrt(np.maximum(0, 70**2 - distance**2)), 1400)
    depth = depth + rng.normal(0, 1, depth.shape)
    ring = labels.astype(bool) & (distance > 60)
    depth[ring] = rng.uniform(880, 1400, int(ring.sum()))
    cloud = only(frame_of(np.rint(depth).astype(np.uint16), labels))
    flying = cloud.points[:, 2] > 0.88
    before = voxels_by_loop(frame_of(np.rint(depth).astype(np.uint16), labels), 1)
    assert (before[:, 2] > 0.88).sum() > 300
    assert flying.sum() <= 0.1 * (before[:, 2] > 0.88).sum()
    assert (~flying).sum() >= 0.93 * (before[:, 2] <= 0.88).sum()


@pytest.mark.parametrize("width", [3, 8])
def test_thin_objects_are_kept(width: int) -> None:
    """A handle 0.29 m long and 4 mm to 1 cm wide."""
    cloud = only(frame_of(flat(800), patch((1, 10, 230, 100, 100 + width))))
    before = voxels_by_loop(frame_of(flat(800), patch((1, 10, 230, 100, 100 + width))), 1)
    assert cloud.reason is None and len(cloud.points) >= 0.9 * len(before)
    assert np.ptp(cloud.points[:, 1]) > 0.25


def test_objects_seen_through_gaps_are_kept_and_flagged() -> None:
    """Single pixels 18 mm apart: none has thirty others within 5 cm."""
    labels = patch()
    labels[10:230:12, 10:310:12] = 1
    cloud = only(frame_of(flat(900), labels))
    assert cloud.reason is None and cloud.kept_by_fallback
    assert len(cloud.points) >= 0.5 * (labels == 1).sum()


def test_both_halves_of_an_object_behind_a_bar_are_kept() -> None:
    labels = patch((1, 40, 120, 20, 240), (2, 40, 120, 120, 180))  # the bar hides 8 cm
    columns = pixels_of(instance_clouds(frame_of(flat(), labels))[0].points)[:, 1]
    left, right = (columns < 120).sum(), (columns >= 179.5).sum()
    assert left + right == len(columns) and left / right == pytest.approx(100 / 60, rel=0.1)


def test_specks_apart_from_the_object_are_dropped() -> None:
    labels = patch((1, 40, 120, 20, 140), (1, 60, 75, 200, 215))
    columns = pixels_of(only(frame_of(flat(), labels)).points)[:, 1]
    assert len(columns) > 500 and columns.max() < 141


# The rules themselves, against plain loops over all distances


def kept_by_loops(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """30 others within 5 cm; mean distance to 30 others up to 1.75 deviations above the mean; pieces 2 cm apart."""
    index, distances = np.arange(len(points)), cdist(points, points)
    relaxed = False
    if len(points) > 30:
        crowded = (distances <= 0.05).sum(axis=1) - 1 >= 30
        relaxed = crowded.mean() < 0.5
        near = np.sort(distances, axis=1)[:, 1:31].mean(axis=1)
        index = index if relaxed else index[crowded]
        index = index[near[index] <= near[index].mean() + 1.75 * near[index].std()]
    pieces: list[set[int]] = []
    left = set(index.tolist())
    while left:
        piece, todo = set(), [left.pop()]
        while todo:
            i = todo.pop()
            piece.add(i)
            found = {j for j in left if distances[i, j] <= 0.02}
            left -= found
            todo += found
        pieces.append(piece)
    largest = max(len(piece) for piece in pieces)
    return np.array(sorted(i for piece in pieces if len(piece) >= 0.1 * largest for i in piece)), relaxed


@pytest.mark.parametrize("count", [1, 2, 29, 30, 31, 32, 33, 101, 400])
@pytest.mark.parametrize("side", [0.01, 0.08, 0.3, 1.0])
def test_outliers_against_loops(count: int, side: float) -> None:
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * side * rng.uniform(0.1, 1, (count, 1))
    before = points.copy()
    kept, relaxed = remove_outliers(points)
    expected, expected_relaxed = kept_by_loops(points)
    np.testing.assert_array_equal(kept, expected)
    assert relaxed == expected_relaxed
    np.testing.assert_array_equal(points, before)


@pytest.mark.parametrize("speck", range(84, 124, 4))
def test_pieces_of_a_tenth_against_loops(speck: int) -> None:
    rng = np.random.default_rng(speck)
    points = rng.uniform(-0.02, 0.02, (900 + speck, 3))
    points[900:] = points[900:] / 2 + 0.2
    kept, _ = remove_outliers(points)
    np.testing.assert_array_equal(kept, kept_by_loops(points)[0])


def test_outliers_of_no_points() -> None:
    kept, relaxed = remove_outliers(np.zeros((0, 3), np.float32))
    assert len(kept) == 0 and not relaxed


# Data beside the checkout


def test_scenes_lose_little(shared: Path) -> None:
    """Simulated frames: outlier removal drops a few hundredths of each object, never most of one."""
    for item, _ in zip(UWISOccluded(shared / "data" / "scenes-dev"), range(3), strict=False):
        points = backproject(item.frame.depth_m, item.frame.intrinsics)
        for cloud in instance_clouds(item.frame):
            assert cloud.reason is None
            everything = points[item.frame.labels == cloud.label]
            everything = everything[(everything[:, 2] >= 0.26) & (everything[:, 2] <= 2.5)]
            assert len(cloud.points) >= 0.85 * len(voxel_downsample(everything, everything, 0.003)[0])


def test_real_frames_have_a_cloud_for_every_object(shared: Path) -> None:
    for item in FrameFolder(shared / "data" / "frames" / "ycbv_posecnn_demo"):
        clouds = {cloud.label: cloud for cloud in instance_clouds(item.frame)}
        for label in item.truth:
            assert clouds[label].reason is None and not clouds[label].kept_by_fallback
            assert np.ptp(clouds[label].points, axis=0).max() < 0.4  # none of these objects is longer
