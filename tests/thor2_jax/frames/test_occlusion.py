"""The occlusion rule on scenes with known boundaries, and against a loop over the pixels of the mask."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.instance_clouds import InstanceCloud, instance_clouds
from thor2_jax.frames.occlusion import OcclusionBoundary, find_occlusion
from training.readers import UWISOccluded

HEIGHT, WIDTH = 120, 160
CAMERA = Intrinsics(300.0, 300.0, 79.5, 59.5)
BACK, FRONT = 1, 2


def occlusions(depth: np.ndarray, labels: np.ndarray) -> dict[int, tuple[InstanceCloud, OcclusionBoundary]]:
    frame = RGBDFrame(np.zeros((*labels.shape, 3), np.uint8), depth, labels, CAMERA)
    return {cloud.label: (cloud, find_occlusion(frame, cloud)) for cloud in instance_clouds(frame)}


def scene(back: int = 800, front: int = 700, table: int = 1000) -> tuple[np.ndarray, np.ndarray]:
    """Return depth in millimetres and labels of two adjacent blocks, at columns 30 to 79 and 80 to 129."""
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[30:90, 30:80] = BACK
    labels[40:100, 80:130] = FRONT
    return np.choose(labels, [table, back, front]).astype(np.uint16), labels


def columns_of(points: np.ndarray) -> np.ndarray:
    return points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx


def rows_of(points: np.ndarray) -> np.ndarray:
    return points[:, 1] / points[:, 2] * CAMERA.fy + CAMERA.cy


# Scenes with known boundaries


def test_the_farther_block_is_occluded_along_the_common_edge() -> None:
    occlusion_by_label = occlusions(*scene())
    cloud, occlusion = occlusion_by_label[BACK]
    assert occlusion.occluded
    assert occlusion.boundary.shape == (len(cloud.points),) and occlusion.boundary.dtype == bool
    marked = cloud.points[occlusion.boundary]
    assert columns_of(marked).min() > 76  # at the edge, rows 40 to 89
    assert rows_of(marked).min() > 37
    assert 35 <= len(marked) <= 50  # 50 pixels of 2.7 mm on a grid of 3 mm


def test_the_nearer_block_is_not_occluded() -> None:
    _, occlusion = occlusions(*scene())[FRONT]
    assert not occlusion.occluded and not occlusion.boundary.any()


def test_blocks_side_by_side_do_not_occlude_each_other() -> None:
    for _, occlusion in occlusions(*scene(back=800, front=800)).values():
        assert not occlusion.occluded and not occlusion.boundary.any()


@pytest.mark.parametrize(("front", "occluded"), [(795, False), (791, False), (788, True)])
def test_nearer_by_more_than_noise(front: int, occluded: bool) -> None:
    assert occlusions(*scene(front=front))[BACK][1].occluded == occluded


def test_nearer_background_does_not_occlude() -> None:
    for _, occlusion in occlusions(*scene(back=800, front=800, table=500)).values():
        assert not occlusion.occluded


@pytest.mark.parametrize("turns", range(4))
def test_each_side(turns: int) -> None:
    depth, labels = (np.rot90(image, turns).copy() for image in scene())
    cloud, occlusion = occlusions(depth, labels)[BACK]
    assert occlusion.occluded and occlusion.boundary.sum() >= 35
    marked = np.stack([rows_of(cloud.points), columns_of(cloud.points)], axis=1)[occlusion.boundary]
    assert cdist(marked, np.argwhere(labels == FRONT)).min(axis=1).max() < 4


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
def test_cut_by_the_border(side: str) -> None:
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    rows = {"top": slice(0, 40), "bottom": slice(80, None)}.get(side, slice(30, 90))
    columns = {"left": slice(0, 50), "right": slice(100, None)}.get(side, slice(40, 120))
    labels[rows, columns] = 1
    cloud, occlusion = occlusions(np.full(labels.shape, 800, np.uint16), labels)[1]
    assert occlusion.occluded and occlusion.boundary.any()
    marked = cloud.points[occlusion.boundary]
    distance = {
        "left": columns_of(marked),
        "right": WIDTH - 1 - columns_of(marked),
        "top": rows_of(marked),
        "bottom": HEIGHT - 1 - rows_of(marked),
    }[side]
    assert distance.max() < 3


def test_one_pixel_off_the_border_is_whole() -> None:
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[1:-1, 1:-1] = 1
    assert not occlusions(np.full(labels.shape, 800, np.uint16), labels)[1][1].occluded
    labels[:] = 1
    assert occlusions(np.full(labels.shape, 800, np.uint16), labels)[1][1].occluded


def test_a_few_pixels_do_not_count_as_occlusion() -> None:
    """The contour of the block is 216 pixels long, of which 5 % are 10.8."""
    for touching, occluded in ((10, False), (11, True)):
        depth, labels = scene()
        labels[40 + touching :, 80:130] = 0
        occlusion = occlusions(depth, labels)[BACK][1]
        assert occlusion.occluded == occluded and occlusion.boundary.any() == occluded


def test_exactly_the_minimum_share_is_occlusion() -> None:
    """The contour of the narrowed block is 200 pixels long."""
    for touching, occluded in ((9, False), (10, True)):
        depth, labels = scene()
        labels[:, 30:38] = 0
        labels[40 + touching :, 80:130] = 0
        assert occlusions(depth, labels)[BACK][1].occluded == occluded


# Missing depth and gaps between masks


@pytest.mark.parametrize(("missing", "occluded"), [(0, True), (3, True), (5, True), (6, False)])
@pytest.mark.parametrize("whose", ["own", "other"])
def test_depth_that_is_missing_along_the_edge(whose: str, missing: int, occluded: bool) -> None:
    depth, labels = scene()
    columns = slice(80 - missing, 80) if whose == "own" else slice(80, 80 + missing)
    depth[:, columns] = 0
    cloud, occlusion = occlusions(depth, labels)[BACK]
    assert occlusion.occluded == occluded
    marked = columns_of(cloud.points[occlusion.boundary])
    if missing <= 3:
        assert marked.min() > 72
    elif whose == "own":  # the edge is at least 13 mm from the cloud
        assert len(marked) == 0


@pytest.mark.parametrize(("gap", "occluded"), [(0, True), (3, True), (4, False)])
def test_gaps_between_masks(gap: int, occluded: bool) -> None:
    depth, labels = scene()
    labels[:, 80 : 80 + gap] = 0
    assert occlusions(depth, labels)[BACK][1].occluded == occluded


def test_depth_of_the_background_in_a_gap_does_not_count() -> None:
    depth, labels = scene(front=800)
    labels[:, 80:82] = 0
    depth[:, 80:82] = 500
    assert not occlusions(depth, labels)[BACK][1].occluded


def test_an_object_does_not_occlude_itself_across_a_gap() -> None:
    depth, labels = scene()
    labels[labels == FRONT] = BACK
    labels[:, 79:81] = 0
    assert not occlusions(depth, labels)[BACK][1].occluded


def test_an_instance_without_depth() -> None:
    depth, labels = scene()
    depth[labels == BACK] = 0
    cloud, occlusion = occlusions(depth, labels)[BACK]
    assert cloud.reason is not None
    assert not occlusion.occluded and occlusion.boundary.shape == (0,)


def test_instances_of_one_pixel() -> None:
    labels = np.zeros((HEIGHT, WIDTH), np.uint16)
    labels[50, 50], labels[0, 0] = 500, 600
    occlusion_by_label = occlusions(np.full(labels.shape, 800, np.uint16), labels)
    assert not occlusion_by_label[500][1].occluded and occlusion_by_label[600][1].occluded
    assert occlusion_by_label[500][1].boundary.shape == (1,)


# Against a loop over the pixels


def occlusion_by_loop(frame: RGBDFrame, cloud: InstanceCloud) -> tuple[bool, np.ndarray]:
    """Apply the rule to masks without gaps or missing depth, where only direct neighbours matter."""
    height, width = frame.labels.shape
    contour, edge = 0, []
    for row, column in zip(*np.nonzero(frame.labels == cloud.label), strict=True):
        own = frame.depth_m[row, column]
        on_contour = on_edge = False
        for r, c in ((row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)):
            if not (0 <= r < height and 0 <= c < width):
                on_contour = on_edge = True
            elif frame.labels[r, c] != cloud.label:
                on_contour = True
                on_edge |= bool(frame.depth_m[r, c] < own - np.float32(0.01))
        contour += on_contour
        if on_edge:
            edge.append(((column - CAMERA.cx) / CAMERA.fx * own, (row - CAMERA.cy) / CAMERA.fy * own, own))
    occluded = len(edge) > 0 and len(edge) >= 0.05 * contour
    marked = np.zeros(len(cloud.points), bool)
    if occluded and len(cloud.points):
        distance = cdist(np.array(edge), cloud.points)
        nearest = distance.argmin(axis=1)
        marked[nearest[distance.min(axis=1) <= 0.012]] = True
    return occluded, marked


@pytest.mark.parametrize("seed", range(4))
def test_against_a_loop_over_the_pixels(seed: int) -> None:
    """The instances fill the image, each at another depth and with a rough surface."""
    rng = np.random.default_rng(seed)
    shape = (61, 83)
    count = 9
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
        occlusion = find_occlusion(frame, cloud)
        assert occlusion.occluded == occluded
        # A boundary pixel halfway between two points may mark either.
        assert (occlusion.boundary != marked).sum() <= 0.02 * len(marked)
        answers.append(occluded)
    assert any(answers) and len(answers) >= 5


# Data beside the checkout


def test_scenes_by_degree_of_occlusion(shared: Path) -> None:
    """The share of occluded instances grows with the degree of occlusion of the scene."""
    dataset = UWISOccluded(shared / "data" / "scenes-dev")
    occluded: dict[str, list[bool]] = {"none": [], "low": [], "high": []}
    for item, _ in zip(dataset, range(12), strict=False):
        for cloud in instance_clouds(item.frame):
            occluded[item.attributes["occlusion"]].append(find_occlusion(item.frame, cloud).occluded)
    share = {degree: np.mean(flags) for degree, flags in occluded.items()}
    assert share["none"] < 0.15 < share["low"] < share["high"] and share["high"] > 0.5
