"""Instance clouds: which pixels become points, and which points of analytic scenes are kept."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from thor2_jax.frames.frames import MAX_INSTANCES, Intrinsics, RGBDFrame, backproject
from thor2_jax.frames.instance_clouds import MIN_POINTS, InstanceCloud, instance_clouds
from thor2_jax.frames.prepared_instance import pack_instances, prepare_instance
from thor2_jax.frames.voxel_grid import voxel_downsample
from training.readers import FrameFolder, UWISOccluded

HEIGHT, WIDTH = 240, 320
CAMERA = Intrinsics(600.0, 610.0, 159.5, 119.5)


def frame_of(depth: np.ndarray, labels: np.ndarray, color: np.ndarray | None = None) -> RGBDFrame:
    if color is None:
        color = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    return RGBDFrame(color, depth, labels, CAMERA)


def flat(millimetres: int = 800) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), millimetres, np.uint16)


def patch(*rectangles: tuple[int, int, int, int, int], kind: Any = np.uint8) -> np.ndarray:
    """Return labels; each rectangle is (label, first row, end row, first column, end column)."""
    labels = np.zeros((HEIGHT, WIDTH), kind)
    for label, top, bottom, left, right in rectangles:
        labels[top:bottom, left:right] = label
    return labels


def pixels_of(points: np.ndarray) -> np.ndarray:
    """Return the rows and columns of points, unrounded."""
    x, y, z = points.T.astype(np.float64)
    return np.stack([y / z * CAMERA.fy + CAMERA.cy, x / z * CAMERA.fx + CAMERA.cx], axis=1)


def voxels_by_loop(frame: RGBDFrame, label: int) -> np.ndarray:
    """Return the means of an instance's points in each cube of 3 mm, in float64, with a loop over the pixels."""
    camera, points = frame.intrinsics, []
    for row, column in zip(*np.nonzero(frame.labels == label), strict=True):
        z = float(np.float32(frame.depth[row, column] / 1000))
        if 0.26 <= z <= 2.5:
            points.append(((column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z, z))
    # Rounded to float32 as the clouds are, so that points at the face of a cube fall on the same side.
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


def test_one_cloud_per_instance_in_the_order_of_labels() -> None:
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


def test_colors_are_those_of_the_mask() -> None:
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


def near_contour(labels: np.ndarray, label: int) -> np.ndarray:
    """Return the pixels [H, W] that an erosion of a mask by two pixels removes; pixels beyond the image are mask."""
    mask = labels == label
    return mask & ~ndimage.binary_erosion(mask, np.ones((5, 5), bool), border_value=1)


@pytest.mark.parametrize("window", [(60, 140, 70, 200), (0, 80, 0, 90), (160, 240, 200, 320), (0, 240, 0, 320)])
def test_the_rim_is_what_an_erosion_of_the_mask_removes(window: tuple[int, int, int, int]) -> None:
    labels = patch((3, *window))
    top, bottom, left, right = window
    labels[(top + bottom) // 2 - 6 : (top + bottom) // 2, (left + right) // 2 :] = 0  # a notch
    labels[top + 20 : top + 30, left + 20 : left + 30] = 9  # an object in front of it
    # One voxel has one pixel at most: a pixel is 8 mm wide here, and a voxel 3 mm.
    frame = RGBDFrame(np.zeros((*labels.shape, 3), np.uint8), flat(), labels, Intrinsics(100.0, 100.0, 160.0, 120.0))
    (cloud,) = (each for each in instance_clouds(frame) if each.label == 3)
    x, y, z = cloud.points.T
    column, row = np.rint(100 * x / z + 160).astype(int), np.rint(100 * y / z + 120).astype(int)
    expected = near_contour(labels, 3)
    assert cloud.rim.dtype == bool and 0 < cloud.rim.sum() < len(cloud.rim)
    np.testing.assert_array_equal(cloud.rim, expected[row, column])


@pytest.mark.parametrize(
    ("label", "window", "has_rim"), [(1, (100, 200, 50, 150), True), (2, (100, 200, 50, 56), False)]
)
def test_prepared_instances_have_a_rim_unless_they_are_narrow(
    label: int, window: tuple[int, int, int, int], has_rim: bool
) -> None:
    frame = frame_of(flat(), patch((label, *window)))
    prepared = prepare_instance(frame, label, 2.5)
    assert prepared.reason is None and prepared.rim is not None
    assert prepared.rim.shape == (len(prepared.points),) and bool(prepared.rim.any()) == has_rim
    if has_rim:
        row, column = pixels_of(prepared.points).T
        inside = np.minimum.reduce([row - 100, 199 - row, column - 50, 149 - column])
        # A voxel of 4 mm has about 4 x 4 pixels; most of those of one on the rim are within 2 pixels of the contour.
        assert inside[prepared.rim].max() < 3 and inside[~prepared.rim].min() > 1
    packed = pack_instances([prepared], 2)
    assert packed.rim is not None and not packed.rim[1].any()
    np.testing.assert_array_equal(packed.rim[0, : len(prepared.rim)], prepared.rim)


def test_unusable_instances_can_be_packed() -> None:
    prepared = prepare_instance(frame_of(flat(0), patch((4, 50, 60, 60, 70))), 4, 2.5)
    assert prepared.reason is not None
    packed = pack_instances([prepared], 1)
    assert packed.rim is not None and not packed.rim.any() and not packed.mask.any()


@pytest.mark.parametrize(("millimetres", "used"), [(0, False), (259, False), (260, True), (2500, True), (2501, False)])
def test_valid_depth(millimetres: int, used: bool) -> None:
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
def test_minimum_number_of_points(pixels: int, usable: bool) -> None:
    """Pixels at a distance of 2.25 m are 3.75 mm apart, one in each voxel."""
    cloud = only(frame_of(flat(2250), patch((1, 5, 6, 10, 10 + pixels))))
    assert (cloud.reason is None) == usable
    if not usable:
        assert f"{pixels} points" in str(cloud.reason) and f"at least {MIN_POINTS}" in str(cloud.reason)


def test_many_pixels_in_few_voxels() -> None:
    cloud = only(frame_of(flat(300), patch((1, 5, 13, 10, 20))))
    assert cloud.n_pixels == 80 and cloud.reason is not None


def test_no_instances() -> None:
    assert instance_clouds(frame_of(flat(), patch())) == []


def test_as_many_instances_as_a_frame_may_have() -> None:
    labels = (np.arange(HEIGHT * WIDTH, dtype=np.int32).reshape(HEIGHT, WIDTH) // 16) % (MAX_INSTANCES + 1)
    clouds = instance_clouds(frame_of(flat(), labels))
    assert [cloud.label for cloud in clouds] == list(range(1, MAX_INSTANCES + 1))
    assert [cloud.n_pixels for cloud in clouds] == np.bincount(labels.ravel())[1:].tolist()


# Which points are dropped


def rays() -> np.ndarray:
    """Return the ray of each pixel at depth 1, [H, W, 3]."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([(column - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, np.ones(row.shape)], axis=-1)


def count_lost(cloud: InstanceCloud, depth: np.ndarray, pixels: np.ndarray) -> int:
    """Count the `pixels`, [H, W] bool, that are farther from all points of the cloud than a voxel's diagonal."""
    points = rays()[pixels] * depth[pixels][:, None]
    return int((KDTree(cloud.points).query(points)[0] > 0.003 * np.sqrt(3)).sum())


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    """Return the depth of a plane through (0, 0, distance), in metres."""
    return distance * normal[2] / (rays() @ normal)


def box_depth(rotation: np.ndarray, sides: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the depth of a box in metres, 0 where a ray misses it."""
    start, direction = -centre @ rotation, rays() @ rotation
    ends = np.stack([(sign * sides / 2 - start) / direction for sign in (-1, 1)])
    enters, leaves = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return np.where(enters < leaves, enters, 0)


def rod_depth(radius: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth of a rod, in metres, and positions along its axis.

    The rod is 0.2 m long, 0.8 m away and `turn` degrees out of the image plane.
    """
    axis, centre = Rotation.from_euler("y", turn, degrees=True).apply([1, 0, 0]), np.array([0, 0, 0.8])
    across, start = rays() - (rays() @ axis)[..., None] * axis, (centre @ axis) * axis - centre
    a, b, c = (across**2).sum(axis=-1), 2 * across @ start, start @ start - radius**2
    root = b**2 - 4 * a * c
    depth = (-b - np.sqrt(np.maximum(root, 0))) / (2 * a)
    place = (rays() * depth[..., None] - centre) @ axis
    return np.where((root > 0) & (np.abs(place) <= 0.1), depth, 0), place


@pytest.mark.parametrize("distance", [0.3, 0.8, 1.5, 2.4])
def test_every_point_of_a_facing_plane_is_kept(distance: float) -> None:
    depth, labels = np.full((HEIGHT, WIDTH), distance), patch((1, 60, 180, 80, 240))
    cloud = only(frame_of(depth, labels))
    assert count_lost(cloud, depth, labels == 1) == 0 and not cloud.kept_by_fallback


@pytest.mark.parametrize("turn", [(60, 0), (-60, 0), (0, 60), (0, -60), (40, 40), (65, 20)])
def test_every_point_of_a_turned_plane_is_kept(turn: tuple[int, int]) -> None:
    depth = plane_depth(Rotation.from_euler("xy", turn, degrees=True).apply([0, 0, 1]), 0.8)
    labels = patch((1, 70, 170, 110, 210))
    cloud = only(frame_of(depth, labels))
    assert count_lost(cloud, depth, labels == 1) == 0 and not cloud.kept_by_fallback


@pytest.mark.parametrize("seed", range(12))
def test_every_point_of_a_box_is_kept(seed: int) -> None:
    """Includes corners and edges; no face is seen at more than about 65 degrees."""
    rng = np.random.default_rng(seed)
    turns = (Rotation.random(rng=rng).as_matrix() for _ in range(1000))
    rotation = next(turn for turn in turns if (np.abs(turn[2]) > 0.45).all())
    depth = box_depth(rotation, rng.uniform(0.05, 0.13, 3), np.array([0.01, -0.02, 0.8]))
    cloud = only(frame_of(depth, (depth > 0).astype(np.uint8)))
    assert (depth > 0).sum() > 2000
    assert count_lost(cloud, depth, depth > 0) == 0 and not cloud.kept_by_fallback


@pytest.mark.parametrize("radius", [0.004, 0.007])
@pytest.mark.parametrize("turn", [0, 30, -60])
def test_a_rod_keeps_its_ends(radius: float, turn: float) -> None:
    depth, place = rod_depth(radius, turn)
    cloud = only(frame_of(depth, (depth > 0).astype(np.uint8)))
    assert count_lost(cloud, depth, depth > 0) == 0 and not cloud.kept_by_fallback
    assert np.ptp(place[depth > 0]) > 0.19


@pytest.mark.parametrize(("width", "fallback"), [(2, True), (4, False), (5, False), (8, False)])
def test_a_flat_strip_is_kept(width: int, fallback: bool) -> None:
    """The strip is 0.26 m long and 3 mm to 1 cm wide; narrow ones may lose 1 cm at either end."""
    labels = patch((1, 20, 220, 100, 100 + width))
    cloud = only(frame_of(flat(800), labels))
    assert cloud.reason is None and cloud.kept_by_fallback == fallback
    assert np.ptp(cloud.points[:, 1]) > 199 * 0.8 / CAMERA.fy - (0.022 if width == 4 else 0.003)


@pytest.mark.parametrize("reach", [0, 1, 2, 3])
@pytest.mark.parametrize("wall", [0.9, 1.4, 2.4, 2.6, 0.0])
def test_a_mask_that_extends_beyond_its_plane(reach: int, wall: float) -> None:
    """The mask includes a border of flying pixels and the wall behind; only the plane is kept, with its corners."""
    rng = np.random.default_rng(reach)
    plane, labels = patch((1, 60, 180, 80, 240)) == 1, patch((1, 60 - reach, 180 + reach, 80 - reach, 240 + reach))
    edge = ndimage.binary_dilation(plane, np.ones((3, 3))) & ~plane
    depth = np.where(plane, 0.8, wall)
    depth[edge] = rng.uniform(0.83, max(wall, 1.0), int(edge.sum()))
    cloud = only(frame_of(depth, labels))
    assert count_lost(cloud, depth, plane) == 0 and not cloud.kept_by_fallback
    assert np.abs(cloud.points[:, 2] - 0.8).max() < 1e-6


@pytest.mark.parametrize(("columns", "stays"), [(10, False), (30, True)])
def test_a_patch_of_wall_stays_if_larger_than_a_tenth(columns: int, stays: bool) -> None:
    """The patches have 6 % and 18 % of the plane's voxels; the column at the step consists of flying pixels."""
    depth = np.where(np.arange(WIDTH) < 240, 0.8, 1.3) * np.ones((HEIGHT, 1))
    labels = patch((1, 40, 200, 80, 240), (1, 90, 150, 240, 240 + columns))
    cloud = only(frame_of(depth, labels))
    far = cloud.points[:, 2] > 1
    assert far.any() == stays and not cloud.kept_by_fallback
    assert count_lost(cloud, depth, (labels == 1) & (depth < 1)) == 0
    if stays:
        assert pixels_of(cloud.points[far])[:, 1].min() > 240.5


def test_single_pixels_of_incorrect_depth_are_removed() -> None:
    rng = np.random.default_rng(0)
    depth, labels = np.full((HEIGHT, WIDTH), 0.8), patch((1, 60, 180, 80, 240))
    incorrect = np.zeros(labels.shape, bool)
    incorrect[66:176:11, 86:236:13] = True
    depth[incorrect] = np.where(rng.random(int(incorrect.sum())) < 0.5, rng.uniform(0.3, 0.7, incorrect.sum()), 1.2)
    cloud = only(frame_of(depth, labels))
    assert np.abs(cloud.points[:, 2] - 0.8).max() < 1e-6 and not cloud.kept_by_fallback
    near_one = ndimage.binary_dilation(incorrect, iterations=2)
    assert count_lost(cloud, depth, (labels == 1) & ~near_one) == 0


def test_flying_pixels_between_a_dome_and_a_wall() -> None:
    """The depth is noisy, and the mask follows a round edge."""
    rng = np.random.default_rng(2)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(rows - 120, columns - 160)
    labels = (distance <= 62).astype(np.uint8)
    depth = np.where(distance <= 60, 850 - np.sqrt(np.maximum(0, 70**2 - distance**2)), 1400)
    depth = depth + rng.normal(0, 1, depth.shape)
    ring = labels.astype(bool) & (distance > 60)
    depth[ring] = rng.uniform(880, 1400, int(ring.sum()))
    frame = frame_of(np.rint(depth).astype(np.uint16), labels)
    cloud, before = only(frame), voxels_by_loop(frame, 1)
    assert (before[:, 2] > 0.88).sum() > 300
    assert (cloud.points[:, 2] > 0.88).sum() <= 0.02 * (before[:, 2] > 0.88).sum()
    assert count_lost(cloud, depth / 1000, labels.astype(bool) & ~ring) == 0


def test_a_surface_steeper_than_the_limit_is_kept_and_flagged() -> None:
    """Depth grows by 18 pixel widths per pixel, so that all but the nearest column are flying pixels."""
    depth = 0.8 * (1 - 18 / CAMERA.fx) ** (100 - np.arange(WIDTH)) * np.ones((HEIGHT, 1))
    labels = patch((1, 80, 160, 100, 130))
    cloud = only(frame_of(depth, labels))
    assert cloud.reason is None and cloud.kept_by_fallback
    assert count_lost(cloud, depth, labels == 1) == 0


@pytest.mark.parametrize(("deep", "flagged"), [(7, False), (8, False), (9, True)])
def test_fallback_if_more_than_half_are_flying_pixels(deep: int, flagged: bool) -> None:
    """`deep` of 16 columns are flying pixels behind the teeth of a comb."""
    depth, labels = np.full((HEIGHT, WIDTH), 0.8), patch((1, 60, 180, 100, 260))
    behind = (np.arange(WIDTH) - 100) % 16
    teeth = {7: (1, 3, 5, 7, 9, 11, 13), 8: (1, 3, 5, 7, 9, 10, 12, 13), 9: (1, 2, 4, 5, 7, 8, 10, 11, 13)}[deep]
    depth[:, np.isin(behind, teeth)] = 0.84
    cloud = only(frame_of(depth, labels))
    assert cloud.kept_by_fallback == flagged
    assert ((cloud.points[:, 2] > 0.81).any()) == flagged


def test_objects_seen_through_gaps_are_kept_and_flagged() -> None:
    """The visible pixels are 18 mm apart, so that none has thirty near neighbours."""
    labels = patch()
    labels[10:230:12, 10:310:12] = 1
    cloud = only(frame_of(flat(900), labels))
    assert cloud.reason is None and cloud.kept_by_fallback
    assert len(cloud.points) >= 0.5 * (labels == 1).sum()


def test_both_halves_of_an_object_behind_a_bar_are_kept() -> None:
    labels = patch((1, 40, 120, 20, 240), (2, 40, 120, 120, 180))  # the bar occludes 8 cm
    cloud = instance_clouds(frame_of(flat(), labels))[0]
    assert count_lost(cloud, flat() / 1000, labels == 1) == 0
    columns = pixels_of(cloud.points)[:, 1]
    left, right = (columns < 120).sum(), (columns >= 179.5).sum()
    assert left + right == len(columns) and left / right == pytest.approx(100 / 60, rel=0.1)


def test_small_separate_pieces_are_dropped() -> None:
    labels = patch((1, 40, 120, 20, 140), (1, 60, 75, 200, 215))
    cloud = only(frame_of(flat(), labels))
    assert count_lost(cloud, flat() / 1000, patch((1, 40, 120, 20, 140)) == 1) == 0
    assert pixels_of(cloud.points)[:, 1].max() < 141


# Data beside the checkout


def test_scenes_lose_little(shared: Path) -> None:
    """Outlier removal drops at most 15 % of each object of simulated frames."""
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
