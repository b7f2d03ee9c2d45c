"""Instance clouds: which pixels become points, which points of analytic scenes are kept, and the occlusion rule."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from image_files import instance_clouds, label_image
from refusals import assert_refused
from scipy import ndimage
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject
from thor2_jax.frames.prepared_instance import PreparedInstance, find_occlusion, pack_instances, prepare_instance
from training.readers.frames import FrameFolder

HEIGHT, WIDTH = 240, 320
CAMERA = Intrinsics(600.0, 610.0, 159.5, 119.5)
NOISE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def frame_of(depth: np.ndarray, labels: np.ndarray, color: np.ndarray = NOISE) -> RGBDFrame:
    return RGBDFrame(color, depth, labels, CAMERA)


def flat(millimetres: int = 800) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), millimetres, np.uint16)


def only(frame: RGBDFrame) -> PreparedInstance:
    (cloud,) = instance_clouds(frame)
    return cloud


# Which pixels become points


def test_intrinsics_with_which_points_are_too_far_apart() -> None:
    frame = frame_of(flat(), label_image((1, 20, 60, 30, 90)))
    absurd = dataclasses.replace(frame, intrinsics=Intrinsics(1e-6, 1e-6, 0, 0))
    assert_refused("^intrinsics place the points of an instance too far apart", instance_clouds, absurd)
    assert_refused("^instance is 99; expected one of 1$", prepare_instance, frame, 99, 2.5)


def test_colors_stay_with_their_points() -> None:
    """The first pixels of the mask are a piece that is dropped, and pixels without depth.

    Green is the row, and red is half the column.
    """
    labels, color = label_image((1, 20, 26, 60, 66), (1, 50, 110, 60, 150)), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    color[..., 0] = np.arange(WIDTH) // 2
    color[..., 1] = np.arange(HEIGHT)[:, None]
    depth = flat()
    depth[50:60] = 0
    cloud = only(frame_of(depth, labels, color))
    x, y, z = cloud.points.T.astype(np.float64)
    row, column = y / z * CAMERA.fy + CAMERA.cy, x / z * CAMERA.fx + CAMERA.cx
    assert np.abs(cloud.colors[:, [1, 0]].T - [row, column / 2]).max() <= 1


@pytest.mark.parametrize("window", [(60, 140, 70, 200), (0, 80, 0, 90), (160, 240, 200, 320), (0, 240, 0, 320)])
def test_the_rim_is_what_an_erosion_of_the_mask_removes(window: tuple[int, int, int, int]) -> None:
    labels = label_image((3, *window))
    top, bottom, left, right = window
    labels[(top + bottom) // 2 - 6 : (top + bottom) // 2, (left + right) // 2 :] = 0  # a notch
    labels[top + 20 : top + 30, left + 20 : left + 30] = 9  # an object in front of it
    # One voxel has one pixel at most: a pixel is 8 mm wide here, and a voxel 3 mm.
    frame = RGBDFrame(np.zeros((*labels.shape, 3), np.uint8), flat(), labels, Intrinsics(100.0, 100.0, 160.0, 120.0))
    (cloud,) = (each for each in instance_clouds(frame) if each.label == 3)
    x, y, z = cloud.points.T
    column, row = np.rint(100 * x / z + 160).astype(int), np.rint(100 * y / z + 120).astype(int)
    mask = labels == 3
    expected = mask & ~ndimage.binary_erosion(mask, np.ones((5, 5)), border_value=1)  # beyond the image is mask
    assert cloud.rim.dtype == bool and 0 < cloud.rim.sum() < len(cloud.rim)
    np.testing.assert_array_equal(cloud.rim, expected[row, column])


@pytest.mark.parametrize(("width", "has_rim"), [(100, True), (6, False)])
def test_prepared_instances_have_a_rim_unless_they_are_narrow(width: int, has_rim: bool) -> None:
    frame = frame_of(flat(), label_image((1, 100, 200, 50, 50 + width)))
    prepared = prepare_instance(frame, 1, 2.5)
    assert prepared.reason is None and prepared.rim is not None and bool(prepared.rim.any()) == has_rim
    packed = pack_instances([prepared], 2)
    assert packed.rim is not None and not packed.rim[1].any()
    np.testing.assert_array_equal(packed.rim[0, : len(prepared.points)], prepared.rim)


@pytest.mark.parametrize(("millimetres", "used"), [(0, False), (259, False), (260, True), (2500, True), (2501, False)])
def test_valid_depth(millimetres: int, used: bool) -> None:
    frame = frame_of(flat(millimetres), label_image((4, 20, 220, 20, 300)))
    cloud = only(frame)
    assert cloud.label == 4
    assert (cloud.reason is None) == used and (len(cloud.points) > 1000) == used
    if used:
        assert count_lost(cloud, frame.depth_m, frame.labels == 4) == 0 and not cloud.kept_by_fallback
    else:
        assert "0 points (56000 pixels" in str(cloud.reason) and "from 0.26 to 2.5 m" in str(cloud.reason)
        assert cloud.points.shape == cloud.colors.shape == (0, 3)
        packed = pack_instances([prepare_instance(frame, 4, 2.5)], 1)
        assert packed.rim is not None and not packed.rim.any() and not packed.mask.any()


@pytest.mark.parametrize(
    ("distance", "size", "points"),
    [(2250, (1, 29), 29), (2250, (1, 30), None), (300, (8, 10), 6)],
    ids=["too few", "enough", "several pixels in each voxel"],
)
def test_minimum_number_of_points(distance: int, size: tuple[int, int], points: int | None) -> None:
    """At a distance of 2.25 m, pixels are 3.75 mm apart, one in each voxel."""
    cloud = only(frame_of(flat(distance), label_image((1, 5, 5 + size[0], 10, 10 + size[1]))))
    assert (cloud.reason is None) == (points is None)
    if points is not None:
        assert f"{points} points" in str(cloud.reason) and "at least 30" in str(cloud.reason)


# Which points are dropped


RAYS = backproject(np.ones((HEIGHT, WIDTH)), CAMERA)
"""The ray of each pixel at depth 1, [H, W, 3]; test_intrinsics.py compares `backproject` with OpenCV."""


def count_lost(cloud: PreparedInstance, depth: np.ndarray, pixels: np.ndarray) -> int:
    """Count the `pixels`, [H, W] bool, that are farther from all points of the cloud than a voxel's diagonal."""
    points = RAYS[pixels] * depth[pixels][:, None]
    return int((KDTree(cloud.points).query(points)[0] > 0.003 * np.sqrt(3)).sum())


def box_depth(rotation: np.ndarray, sides: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the depth of a box in metres, 0 where a ray misses it."""
    start, direction = -centre @ rotation, RAYS @ rotation
    ends = np.stack([(sign * sides / 2 - start) / direction for sign in (-1, 1)])
    enters, leaves = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    return np.where(enters < leaves, enters, 0)


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


@pytest.mark.parametrize(("width", "fallback"), [(2, True), (4, False), (5, False), (8, False)])
def test_a_flat_strip_is_kept(width: int, fallback: bool) -> None:
    """The strip is 0.26 m long and 3 mm to 1 cm wide; narrow ones may lose 1 cm at either end."""
    labels = label_image((1, 20, 220, 100, 100 + width))
    cloud = only(frame_of(flat(800), labels))
    assert cloud.reason is None and cloud.kept_by_fallback == fallback
    assert np.ptp(cloud.points[:, 1]) > 199 * 0.8 / CAMERA.fy - (0.022 if width == 4 else 0.003)


@pytest.mark.parametrize("reach", [0, 1, 2, 3])
@pytest.mark.parametrize("wall", [0.9, 1.4, 2.4, 2.6, 0.0])
def test_a_mask_that_extends_beyond_its_plane(reach: int, wall: float) -> None:
    """The mask includes a border of flying pixels and the wall behind; only the plane is kept, with its corners."""
    rng = np.random.default_rng(reach)
    plane = label_image((1, 60, 180, 80, 240)) == 1
    labels = label_image((1, 60 - reach, 180 + reach, 80 - reach, 240 + reach))
    edge = ndimage.binary_dilation(plane, np.ones((3, 3))) & ~plane
    depth = np.where(plane, 0.8, wall)
    depth[edge] = rng.uniform(0.83, max(wall, 1.0), int(edge.sum()))
    cloud = only(frame_of(depth, labels))
    assert count_lost(cloud, depth, plane) == 0 and not cloud.kept_by_fallback
    assert np.abs(cloud.points[:, 2] - 0.8).max() < 1e-6


def test_a_strip_of_the_table_beside_an_object_is_dropped() -> None:
    """The strip is six pixels wide, begins at the foot of the object and ends 24 cm behind it."""
    labels = label_image((1, 60, 180, 100, 196))
    depth = np.full((HEIGHT, WIDTH), 0.8) + np.maximum(180 - np.arange(HEIGHT)[:, None], 0) * 0.002
    depth[:, :190] = 0.8
    cloud = only(frame_of(depth, labels))
    assert count_lost(cloud, depth, (labels == 1) & (depth == 0.8)) == 0 and not cloud.kept_by_fallback
    assert cloud.points[:, 2].max() < 0.87


@pytest.mark.parametrize("reach", [0, 3, 6])
@pytest.mark.parametrize("height", [0.02, 0.1])
def test_a_table_in_a_mask_that_is_too_large_is_dropped(height: float, reach: int) -> None:
    """The camera looks at a box on a table, obliquely; no point of the table beside the box is 5 cm behind it."""
    rotation, center = Rotation.from_euler("xz", [130, 20], degrees=True).as_matrix(), np.array([0.0, 0, 0.7])
    box = box_depth(rotation, np.array([0.1, 0.08, height]), center)
    up = rotation[:, 2]
    table = (up @ center - height / 2) / (RAYS @ up)
    depth = np.where(box > 0, box, table) + np.random.default_rng(reach).normal(0, 0.0005, box.shape)
    labels = ndimage.binary_dilation(box > 0, np.ones((3, 3)), iterations=reach) if reach else box > 0
    cloud = only(frame_of(depth, labels.astype(np.uint8)))
    above, limit = (RAYS * depth[..., None] - center) @ up + height / 2, min(0.005, 0.1 * height)
    assert count_lost(cloud, depth, (box > 0) & (above > 0.01)) == 0 and not cloud.kept_by_fallback
    heights = (cloud.points - center) @ up + height / 2
    assert (heights < 0.8 * limit).mean() < 0.002 and (heights < 1.5 * limit).any()


def test_a_rule_that_is_skipped_leaves_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    module = "thor2_jax.frames.prepared_instance."
    frame = frame_of(flat(800), label_image((1, 60, 180, 100, 260)))
    monkeypatch.setattr(module + "flying_pixels", lambda _, pixels: np.arange(len(pixels)) < len(pixels) // 4)
    expected = only(frame)
    monkeypatch.setattr(module + "strip_pixels", lambda _, pixels, *__: np.ones(len(pixels), bool))
    cloud = only(frame)
    assert cloud.kept_by_fallback and not expected.kept_by_fallback
    np.testing.assert_array_equal(cloud.points, expected.points)


def test_the_bottom_of_a_cup_is_kept() -> None:
    labels = label_image((1, 60, 180, 100, 220))
    inside = label_image((1, 64, 176, 104, 216)) == 1
    depth = np.where(inside, 0.9, np.where(labels == 1, 0.8, 0.902))  # the bottom is nearly on the table
    cloud = only(frame_of(depth, labels))
    flying = inside & ~ndimage.binary_erosion(inside)
    assert count_lost(cloud, depth, (labels == 1) & ~flying) == 0


@pytest.mark.parametrize(("deep", "flagged"), [(7, False), (8, False), (9, True)])
def test_fallback_if_more_than_half_are_flying_pixels(deep: int, flagged: bool) -> None:
    """`deep` of 16 columns are flying pixels behind the teeth of a comb."""
    depth, labels = np.full((HEIGHT, WIDTH), 0.8), label_image((1, 60, 180, 100, 260))
    behind = (np.arange(WIDTH) - 100) % 16
    teeth = {7: (1, 3, 5, 7, 9, 11, 13), 8: (1, 3, 5, 7, 9, 10, 12, 13), 9: (1, 2, 4, 5, 7, 8, 10, 11, 13)}[deep]
    depth[:, np.isin(behind, teeth)] = 0.84
    cloud = only(frame_of(depth, labels))
    assert cloud.kept_by_fallback == flagged
    assert ((cloud.points[:, 2] > 0.81).any()) == flagged


# Data beside the checkout


def test_real_frames_have_a_cloud_for_every_object(shared: Path) -> None:
    for item in FrameFolder(shared / "data" / "frames" / "ycbv_posecnn_demo"):
        clouds = {cloud.label: cloud for cloud in instance_clouds(item.frame)}
        for label in item.truth:
            assert clouds[label].reason is None and not clouds[label].kept_by_fallback
            assert np.ptp(clouds[label].points, axis=0).max() < 0.4  # none of these objects is longer


# What the camera sees around an instance


def test_around_an_instance_are_the_points_of_other_pixels() -> None:
    """The box of an instance is enlarged by a quarter; the mask counts two pixels more on each side."""
    labels, depth = label_image((1, 100, 140, 100, 180), (2, 100, 140, 190, 200)), flat(1000)
    depth[labels == 1], depth[:, 190:200], depth[:90] = 800, 850, 0
    frame = frame_of(depth, labels)
    instance = prepare_instance(frame, 1, 2.5)
    around = instance.around
    assert around is not None and around.dtype == np.float32
    size = len(around)
    x, y = (around[..., 0] * CAMERA.fx + CAMERA.cx), (around[..., 1] * CAMERA.fy + CAMERA.cy)
    np.testing.assert_allclose(x, np.broadcast_to(np.linspace(77, 202, size), (size, size)), atol=1)
    np.testing.assert_allclose(y.T, np.broadcast_to(np.linspace(87, 152, size), (size, size)), atol=1)
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    is_own = ndimage.binary_dilation(labels == 1, np.ones((5, 5)))[row, column]
    np.testing.assert_array_equal(around[..., 2], np.where(is_own, 0, depth[row, column] / np.float32(1000)))
    packed = pack_instances([instance, dataclasses.replace(instance, around=None)], 4)
    np.testing.assert_array_equal(packed.around, [around, *[np.zeros_like(around)] * 3])


@pytest.mark.parametrize("size", [(HEIGHT, WIDTH), (1, 3000), (3000, 1), (4, 1000)])
def test_instances_that_fill_the_image_have_nothing_around(size: tuple[int, int]) -> None:
    depth = np.full(size, 1000, np.uint16)
    frame = RGBDFrame(np.zeros((*size, 3), np.uint8), depth, np.ones(size, np.uint8), CAMERA)
    around = prepare_instance(frame, 1, 2.5).around
    assert around is not None and np.isfinite(around).all() and not around[..., 2].any()


def test_around_an_instance_behind_a_distorting_lens() -> None:
    """The depth grows by 1 mm with each column, in which OpenCV projects the point."""
    camera = dataclasses.replace(CAMERA, distortion=(0.8, -0.5, 0.01, 0.02, 0.0))
    depth = (1000 + np.arange(WIDTH)).astype(np.uint16) + flat(0)
    frame = RGBDFrame(NOISE, depth, label_image((1, 190, 220, 250, 300)), camera)
    around = prepare_instance(frame, 1, 2.5).around
    rays = np.dstack([around[..., :2], np.ones(around.shape[:2])]).reshape(-1, 3)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))[0].reshape(-1, 2)
    seen = around[..., 2].ravel() > 0
    assert seen.sum() > 50
    np.testing.assert_allclose(1000 * around[..., 2].ravel()[seen] - 1000, pixels[seen, 0], atol=0.51)


def test_around_at_the_image_border() -> None:
    """Pixels within the width of the rim of the border are left out; only trusted depth is kept."""
    labels, depth = label_image((1, 0, 60, 0, 60), (2, 200, 240, 260, 320)), flat(1000)
    depth[:, 62:66], depth[63:66] = 200, 10100
    for label, x, y in ((1, (2, 77), (2, 77)), (2, (242, 317), (187, 237))):
        around = prepare_instance(frame_of(depth, labels), label, 2.5).around
        columns, rows = around[0, :, 0] * CAMERA.fx + CAMERA.cx, around[:, 0, 1] * CAMERA.fy + CAMERA.cy
        np.testing.assert_allclose([*columns[[0, -1]], *rows[[0, -1]]], [*x, *y], atol=0.01)
        assert set(np.unique(around[..., 2])) <= {np.float32(0), np.float32(1)}
        assert (around[..., 2] == 1).any()


# Occlusion: scenes with known boundaries


WIDE_CAMERA = Intrinsics(300.0, 300.0, 79.5, 59.5)
BACK, FRONT = 1, 2


def occlusions(depth: np.ndarray, labels: np.ndarray) -> dict[int, tuple[bool, np.ndarray]]:
    """Return for each instance whether it is occluded, and its boundary points."""
    frame = RGBDFrame(np.zeros((*labels.shape, 3), np.uint8), depth, labels, WIDE_CAMERA)
    return {cloud.label: find_occlusion(frame, cloud) for cloud in instance_clouds(frame)}


def scene(back: int = 800, front: int = 700, table: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Return depth in millimetres and labels of two adjacent blocks, at columns 30 to 79 and 80 to 129."""
    labels = label_image((BACK, 30, 90, 30, 80), (FRONT, 40, 100, 80, 130), shape=(120, 160))
    return np.choose(labels, [table, back, front]).astype(np.uint16), labels


@pytest.mark.parametrize(("touching", "front", "occluded"), [(9, 789, False), (10, 791, False), (10, 789, True)])
def test_a_share_of_the_contour_is_behind_another_instance(touching: int, front: int, occluded: bool) -> None:
    """The contour of the narrowed block is 200 pixels long, of which 5 % are 10; by 1 cm, depth differs as noise."""
    depth, labels = scene(front=front)
    labels[:, 30:38] = 0
    labels[40 + touching :, 80:130] = 0
    is_occluded, boundary = occlusions(depth, labels)[BACK]
    assert is_occluded == occluded and boundary.any() == occluded


@pytest.mark.parametrize(("missing", "occluded"), [(5, True), (6, False)])
@pytest.mark.parametrize("whose", ["own", "other"])
@pytest.mark.parametrize("value", [0, 65535])
def test_depth_may_be_missing_along_the_edge(value: int, whose: str, missing: int, occluded: bool) -> None:
    """Some cameras write the largest value where there is no depth."""
    depth, labels = scene()
    depth[:, slice(80 - missing, 80) if whose == "own" else slice(80, 80 + missing)] = value
    is_occluded, boundary = occlusions(depth, labels)[BACK]
    assert is_occluded == occluded
    # Without its own depth, the edge is at least 13 mm from the cloud.
    assert boundary.any() == (occluded and whose == "other")


@pytest.mark.parametrize(("gap", "occluded"), [(3, True), (4, False)])
def test_gaps_between_masks(gap: int, occluded: bool) -> None:
    depth, labels = scene()
    labels[:, 80 : 80 + gap] = 0
    assert occlusions(depth, labels)[BACK][0] == occluded


def test_background_and_other_parts_of_the_object_do_not_occlude() -> None:
    depth, labels = scene(table=500)
    for front in (0, BACK):
        parts = np.where(labels == FRONT, front, labels)
        parts[:, 79:81] = 0
        assert not occlusions(depth, parts)[BACK][0]


def test_instances_without_depth_or_of_one_pixel() -> None:
    depth, labels = scene()
    labels[labels == FRONT] = 0
    depth[labels == BACK] = 0
    labels[0, 0], labels[110, 50] = 3, 4
    is_occluded = {label: occluded for label, (occluded, _) in occlusions(depth, labels).items()}
    assert is_occluded == {BACK: False, 3: True, 4: False}  # 3 is at the border of the image


# Occlusion: against a loop over the pixels


def occlusion_by_loop(frame: RGBDFrame, cloud: PreparedInstance) -> tuple[bool, np.ndarray]:
    """Apply the rule to masks without gaps or missing depth, where only direct neighbours matter."""
    labels = np.pad(frame.label_image, 1, constant_values=-1)
    depth = np.pad(frame.depth_m, 1)  # 0 outside the image, nearer than everything
    contour, edge = 0, []
    for row, column in np.argwhere(labels == cloud.label):
        own = depth[row, column]
        beside = ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1))
        others = [pixel for pixel in beside if labels[pixel] != cloud.label]
        contour += len(others) > 0
        if any(depth[pixel] < own - np.float32(0.01) for pixel in others):
            edge.append(
                [
                    (column - 1 - WIDE_CAMERA.cx) / WIDE_CAMERA.fx * own,
                    (row - 1 - WIDE_CAMERA.cy) / WIDE_CAMERA.fy * own,
                    own,
                ]
            )
    occluded = len(edge) > 0 and len(edge) >= 0.05 * contour
    marked = np.zeros(len(cloud.points), bool)
    if occluded and len(cloud.points):
        distance = cdist(edge, cloud.points)
        marked[distance.argmin(axis=1)[distance.min(axis=1) <= 0.012]] = True
    return occluded, marked


@pytest.mark.parametrize("seed", range(4))
def test_against_a_loop_over_the_pixels(seed: int) -> None:
    """The instances fill the image, each at another depth and with a rough surface."""
    rng = np.random.default_rng(seed)
    shape, count = (61, 83), 9
    centres = rng.uniform(0, 1, (count, 2)) * shape
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    wobble = ndimage.gaussian_filter(rng.normal(size=(count, *shape)), (0, 3, 3)) * 60
    far = np.hypot(rows - centres[:, 0, None, None], columns - centres[:, 1, None, None]) + wobble
    labels = far.argmin(axis=0) + 1
    depth = 0.6 + 0.02 * rng.integers(0, 6, count + 1)[labels] + rng.normal(0, 0.003, shape)
    frame = RGBDFrame(np.zeros((*shape, 3), np.uint8), depth.astype(np.float32), labels, WIDE_CAMERA)
    answers = []
    for cloud in instance_clouds(frame):
        occluded, marked = occlusion_by_loop(frame, cloud)
        is_occluded, boundary = find_occlusion(frame, cloud)
        assert is_occluded == occluded
        # A boundary pixel halfway between two points may mark either.
        assert (boundary != marked).sum() <= 0.02 * len(marked)
        answers.append(occluded)
    assert any(answers) and len(answers) >= 5
