"""The occlusion rule on scenes with known boundaries, and against a loop over the pixels of the mask."""

import numpy as np
import pytest
from image_files import instance_clouds, label_image
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance, find_occlusion

CAMERA = Intrinsics(300.0, 300.0, 79.5, 59.5)
BACK, FRONT = 1, 2


def occlusions(depth: np.ndarray, labels: np.ndarray) -> dict[int, tuple[bool, np.ndarray]]:
    """Return for each instance whether it is occluded, and its boundary points."""
    frame = RGBDFrame(np.zeros((*labels.shape, 3), np.uint8), depth, labels, CAMERA)
    return {cloud.label: find_occlusion(frame, cloud) for cloud in instance_clouds(frame)}


def scene(back: int = 800, front: int = 700, table: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Return depth in millimetres and labels of two adjacent blocks, at columns 30 to 79 and 80 to 129."""
    labels = label_image((BACK, 30, 90, 30, 80), (FRONT, 40, 100, 80, 130), shape=(120, 160))
    return np.choose(labels, [table, back, front]).astype(np.uint16), labels


# Scenes with known boundaries


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


# Against a loop over the pixels


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
            edge.append([(column - 1 - CAMERA.cx) / CAMERA.fx * own, (row - 1 - CAMERA.cy) / CAMERA.fy * own, own])
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
    wobble = gaussian_filter(rng.normal(size=(count, *shape)), (0, 3, 3)) * 60
    far = np.hypot(rows - centres[:, 0, None, None], columns - centres[:, 1, None, None]) + wobble
    labels = far.argmin(axis=0) + 1
    depth = 0.6 + 0.02 * rng.integers(0, 6, count + 1)[labels] + rng.normal(0, 0.003, shape)
    frame = RGBDFrame(np.zeros((*shape, 3), np.uint8), depth.astype(np.float32), labels, CAMERA)
    answers = []
    for cloud in instance_clouds(frame):
        occluded, marked = occlusion_by_loop(frame, cloud)
        is_occluded, boundary = find_occlusion(frame, cloud)
        assert is_occluded == occluded
        # A boundary pixel halfway between two points may mark either.
        assert (boundary != marked).sum() <= 0.02 * len(marked)
        answers.append(occluded)
    assert any(answers) and len(answers) >= 5
