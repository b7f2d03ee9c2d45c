"""Segmentation of things on a table, on synthetic scenes whose instances are known."""

import dataclasses

import numpy as np
import pytest
from helpers import slow
from segmentation_scenes import Box, best_overlaps, render

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.segmentation.table import _refined, _trimmed, segment_table

RED, BLUE, GREEN, YELLOW = (190, 30, 40), (30, 60, 190), (30, 150, 60), (220, 200, 40)
APART = [
    Box(-0.2, 0.05, (0.04, 0.06), 0.12, RED),
    Box(0.0, -0.1, (0.05, 0.03), 0.06, BLUE),
    Box(0.2, 0.1, (0.03, 0.03), 0.15, GREEN),
]


@pytest.mark.parametrize("pose", [(40, 0, 0, 0.9), (55, 30, 5, 0.8), (20, -70, -10, 1.1), (65, 140, 0, 0.9)])
def test_boxes_apart_are_found_in_any_pose(pose: tuple[float, ...]) -> None:
    frame = render(APART, *pose)
    labels = segment_table(frame)
    assert labels.max() == 3
    assert (best_overlaps(labels, frame.label_image) > 0.85).all()


def test_boxes_that_touch_in_the_image_are_split_at_the_step() -> None:
    frame = render([Box(0.0, 0.12, (0.08, 0.03), 0.2, RED), Box(0.01, -0.06, (0.05, 0.03), 0.1, (180, 40, 40))], 55)
    labels = segment_table(frame)
    assert labels.max() == 2
    assert (best_overlaps(labels, frame.label_image) > 0.85).all()


def test_boxes_that_meet_at_a_fold_are_split_by_their_colors() -> None:
    boxes = [Box(0.0, 0.0, (0.09, 0.09), 0.05, YELLOW), Box(0.0, 0.04, (0.05, 0.04), 0.12, BLUE, bottom=0.05)]
    frame = render(boxes, 50, distance=0.6)
    labels = segment_table(frame)
    assert (best_overlaps(labels, frame.label_image) > 0.75).all()


def test_flat_strips_are_found_by_their_color() -> None:
    strips = [Box(-0.15, 0.0, (0.08, 0.008), 0, BLUE), Box(0.1, 0.1, (0.008, 0.07), 0, (20, 20, 20))]
    frame = render(strips, 30)
    labels = segment_table(frame)
    assert labels.max() == 2
    assert (best_overlaps(labels, frame.label_image) > 0.7).all()


@pytest.mark.parametrize("height", [0.004, 0.02])
def test_books_whose_tops_lie_in_one_plane(height: float) -> None:
    """Their tops are no table, and those that are lower than the noise are larger than the window of the colour."""
    books = [
        Box(-0.25, 0.1, (0.08, 0.11), height, BLUE),
        Box(0.0, 0.1, (0.07, 0.1), height, (235, 235, 235)),
        Box(0.25, 0.05, (0.08, 0.11), height, YELLOW),
        Box(-0.15, -0.2, (0.1, 0.1), height, (225, 220, 215)),
        Box(0.1, -0.2, (0.09, 0.09), height, (30, 30, 30)),
    ]
    frame = render(books, 45, distance=1.1)
    labels = segment_table(frame)
    assert labels.max() == 5
    assert (best_overlaps(labels, frame.label_image) > 0.85).all()


def test_a_soft_shadow_is_not_a_thing() -> None:
    frame = render(APART[:1])
    row, column = np.mgrid[0:240, 0:320]
    shade = 1 - 0.4 * np.exp(-((row - 170) ** 2 + (column - 230) ** 2) / (2 * 25**2))
    color = (frame.color * shade[..., None]).astype(np.uint8)
    assert segment_table(dataclasses.replace(frame, color=color)).max() == 1


def test_an_empty_table_has_no_things() -> None:
    assert not segment_table(render([])).any()


@pytest.mark.parametrize("depth", [0, 100, 60000])
def test_frames_without_usable_depth_have_no_things(depth: int) -> None:
    frame = render(APART)
    empty = dataclasses.replace(frame, depth=np.full_like(frame.depth, depth))
    assert not segment_table(empty).any()


def test_frames_without_a_plane_have_no_things() -> None:
    assert not segment_table(render(APART, plane=False)).any()
    rng = np.random.default_rng(0)
    frame = render(APART)
    noise = rng.integers(400, 2400, frame.depth.shape).astype(np.uint16)
    assert not segment_table(dataclasses.replace(frame, depth=noise)).any()


def test_wall_sized_and_tiny_pieces_are_dropped() -> None:
    frame = render([Box(0.0, 0.3, (0.6, 0.02), 0.9, RED), Box(0.1, -0.05, (0.005, 0.005), 0.01, BLUE), APART[1]], 60)
    labels = segment_table(frame)
    assert best_overlaps(labels, frame.label_image)[2] > 0.8
    assert set(np.unique(labels[frame.label_image == 1])) == {0}


def test_depth_with_nan_and_holes() -> None:
    frame = render(APART)
    holes = np.random.default_rng(1).random(frame.depth.shape) < 0.1
    metres = np.where(holes, np.float32(np.nan), frame.depth_m)
    metres[:30] = np.inf
    labels = segment_table(dataclasses.replace(frame, depth=metres))
    assert (best_overlaps(labels, frame.label_image)[:2] > 0.8).all()


def test_equal_frames_get_equal_labels() -> None:
    frame = render(APART)
    color, depth = frame.color.copy(), frame.depth.copy()
    labels = segment_table(frame)
    np.testing.assert_array_equal(segment_table(frame), labels)
    np.testing.assert_array_equal(frame.color, color)
    np.testing.assert_array_equal(frame.depth, depth)
    assert labels.shape == frame.depth.shape and labels.dtype == np.int32
    assert sorted(np.unique(labels)) == list(range(labels.max() + 1))


def test_labels_of_the_frame_are_not_read() -> None:
    frame = render(APART)
    np.testing.assert_array_equal(segment_table(dataclasses.replace(frame, labels=None)), segment_table(frame))


def test_a_mirrored_frame_has_mirrored_labels() -> None:
    frame = render(APART)
    camera = frame.intrinsics
    mirrored = RGBDFrame(
        np.ascontiguousarray(frame.color[:, ::-1]),
        np.ascontiguousarray(frame.depth[:, ::-1]),
        None,
        Intrinsics(camera.fx, camera.fy, 319 - camera.cx, camera.cy),
    )
    labels, again = segment_table(frame), segment_table(mirrored)[:, ::-1]
    assert labels.max() == again.max() == 3
    assert (best_overlaps(again, labels) > 0.9).all()


@pytest.mark.parametrize("size", [(481, 641), *slow((480, 640), (720, 1280))])
def test_larger_images_have_labels_of_their_size(size: tuple[int, int]) -> None:
    frame = render(APART, size=size)
    labels = segment_table(frame)
    assert labels.shape == size
    assert (best_overlaps(labels, frame.label_image) > 0.85).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 2), (17, 400)])
def test_images_of_few_pixels(size: tuple[int, int]) -> None:
    frame = RGBDFrame(
        np.full((*size, 3), 90, np.uint8), np.full(size, 900, np.uint16), None, Intrinsics(500.0, 500.0, 0.0, 0.0)
    )
    assert segment_table(frame).shape == size


def test_borders_are_refined_as_in_the_whole_image() -> None:
    """Only the part of the image around the pieces is flooded; a far piece makes it the whole image."""
    color = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    labels = np.zeros((48, 64), np.int32)
    labels[20:30, 12:30] = 1
    alone = _refined(labels, color, 2)
    labels[0:4, 0:4], labels[44:48, 60:64] = 2, 3
    np.testing.assert_array_equal(alone == 1, _refined(labels, color, 2) == 1)
    assert not _refined(np.zeros_like(labels), color, 2).any()


def test_the_rim_of_thick_things_is_trimmed() -> None:
    labels = np.zeros((80, 120), np.int32)
    labels[5:65, 10:70] = 1
    labels[5:65, 70:110] = 2  # beside it
    labels[70:73, 10:110] = 3  # thin
    trimmed = _trimmed(labels, 3)
    expected = np.zeros_like(labels)
    expected[6:64, 11:69] = 1
    expected[6:64, 71:109] = 2
    expected[70:73, 10:110] = 3
    np.testing.assert_array_equal(trimmed, expected)
    np.testing.assert_array_equal(_trimmed(labels, 1), labels)
