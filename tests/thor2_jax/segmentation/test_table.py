"""Segmentation of things on a table, on synthetic scenes whose instances are known."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import trimesh
from image_files import label_image
from segmentation_scenes import APART, CAMERA, TABLE_TOP, Box, best_overlaps, camera_pose, cast, render, surface
from slow_tier import slow

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject
from thor2_jax.segmentation.foreground import _depth_edges, _plane_color
from thor2_jax.segmentation.planes import DepthImage, dominant_planes
from thor2_jax.segmentation.table import _refined, _trimmed, _without_holes, segment_table

RED, BLUE, YELLOW = (190, 30, 40), (30, 60, 190), (220, 200, 40)
TOUCHING = [Box(0.0, 0.12, (0.08, 0.03), 0.2, RED), Box(0.01, -0.06, (0.05, 0.03), 0.1, (180, 40, 40))]
STACKED = [Box(0.0, 0.0, (0.09, 0.09), 0.05, YELLOW), Box(0.0, 0.04, (0.05, 0.04), 0.12, BLUE, bottom=0.05)]
ON_TABLE = [
    Box(0.0, 0.0, (0.3, 0.22), 0.4, (170, 160, 150)),
    Box(-0.15, 0.03, (0.04, 0.06), 0.12, RED, bottom=0.4),
    Box(-0.45, 0.1, (0.05, 0.05), 0.1, YELLOW),
]
TRAY = [
    Box(0.0, 0.0, (0.25, 0.2), 0.02, (200, 200, 190)),
    Box(-0.13, 0.05, (0.04, 0.05), 0.1, RED, bottom=0.02),
    Box(0.0, -0.09, (0.05, 0.03), 0.06, BLUE, bottom=0.02),
    Box(0.35, 0.05, (0.04, 0.05), 0.1, YELLOW),
]
STRIPS = [Box(-0.15, 0.0, (0.08, 0.008), 0, BLUE), Box(0.1, 0.1, (0.008, 0.07), 0, (20, 20, 20))]


def books(height: float) -> list[Box]:
    """Return books whose tops lie in one plane, which is no table; thin ones are lower than the noise."""
    return [
        Box(-0.25, 0.1, (0.08, 0.11), height, BLUE),
        Box(0.0, 0.1, (0.07, 0.1), height, (235, 235, 235)),
        Box(0.25, 0.05, (0.08, 0.11), height, YELLOW),
        Box(-0.15, -0.2, (0.1, 0.1), height, (225, 220, 215)),
        Box(0.1, -0.2, (0.09, 0.09), height, (30, 30, 30)),
    ]


POSES = [(40, 0, 0, 0.9), (55, 30, 5, 0.8), (20, -70, -10, 1.1), (65, 140, 0, 0.9)]
SCENES: dict[str, tuple[list[Box], tuple[float, ...], float]] = {
    **{f"apart {pose}": (APART, pose, 0.91) for pose in POSES},
    "touching in the image": (TOUCHING, (55,), 0.93),
    "meeting at a fold": (STACKED, (50, 0, 0, 0.6), 0.95),
    "on a table and on the floor": (ON_TABLE, (30, 0, 0, 1.3), 0.92),
    "on a tray and beside it": (TRAY, (40,), 0.83),
    "flat and large": ([Box(0.0, 0.0, (0.18, 0.18), 0.05, RED)], (20,), 0.9),
    "half of the image": ([Box(0.0, 0.0, (0.12, 0.1), 0.05, RED)], (30, 0, 0, 0.36), 0.95),
    "on a sheet": ([Box(0.0, 0.0, (0.14, 0.1), 0, BLUE), Box(0.0, 0.0, (0.03, 0.03), 0.06, RED)], (20,), 0.9),
    "flat strips": (STRIPS, (30,), 0.95),
    **{f"books of {height} m": (books(height), (45, 0, 0, 1.1), 0.94) for height in (0.004, 0.02)},
}
"""Name -> boxes, pose of the camera, and least overlap with a piece of each box, except for tables and trays."""


@pytest.mark.parametrize("name", SCENES)
def test_each_box_of_a_scene_is_a_thing(name: str) -> None:
    boxes, pose, least = SCENES[name]
    frame = render(boxes, *pose)
    before = frame.color.copy(), frame.depth.copy()
    labels = segment_table(dataclasses.replace(frame, labels=None))
    things = [box.half[0] < 0.2 for box in boxes]
    assert labels.dtype == np.int32 and sorted(np.unique(labels)) == list(range(sum(things) + 1))
    assert (best_overlaps(labels, frame.label_image)[things] > least).all()
    np.testing.assert_array_equal(segment_table(frame), labels)  # its own labels are not read
    np.testing.assert_equal((frame.color, frame.depth), before)


WHITE, DARK_RED = (225, 225, 220), (170, 60, 50)
BOWL = [(0, 0), (0.04, 0), (0.07, 0.03), (0.08, 0.06), (0.076, 0.06), (0.066, 0.03), (0.038, 0.006), (0, 0.006)]
CUP = [(0, 0), (0.04, 0), (0.04, 0.1), (0.036, 0.1), (0.036, 0.006), (0, 0.006)]


def revolved(profile: list[tuple[float, float]], x: float, color: Any, inside: Any = None) -> Any:
    """Return the solid of revolution of a closed profile (radius, height), at `x`."""
    mesh = trimesh.creation.revolve(np.array([*profile, profile[0]]), sections=48)
    is_inside = np.linalg.norm(mesh.triangles_center[:, :2], axis=1, keepdims=True) < 0.0385
    mesh.apply_translation([x, 0, 0])
    light = 0.55 + 0.45 * np.clip(mesh.face_normals @ (0.3, -0.2, 0.93), 0, 1)
    return surface(mesh, np.where(is_inside, color if inside is None else inside, color) * light[:, None])


@pytest.mark.parametrize("tilt", [40, 50, 60])
def test_bowls_and_cups_are_one_thing_each(tilt: float) -> None:
    things = [revolved(BOWL, -0.15, WHITE), revolved(CUP, 0.02, DARK_RED, inside=WHITE), revolved(BOWL, 0.2, DARK_RED)]
    hits = cast([TABLE_TOP, *things], camera_pose(tilt), 0.8, CAMERA, (240, 320))
    depth, truth = (values.reshape(240, 320) for values in (np.rint(hits.distance * 1000), hits.mesh))
    frame = RGBDFrame(hits.color.reshape(240, 320, 3), depth.astype(np.uint16), truth, CAMERA)
    assert (best_overlaps(segment_table(frame), frame.label_image) > 0.95).all()


@pytest.mark.parametrize("size", [(481, 641), *slow((480, 640), (720, 1280))])
def test_larger_images_have_labels_of_their_size(size: tuple[int, int]) -> None:
    frame = render(APART, size=size)
    assert (best_overlaps(segment_table(frame), frame.label_image) > 0.93).all()


def test_the_nearest_large_plane_is_the_support() -> None:
    """Its coefficients absorb the distortion of a sensor; depth that is too near is not used."""
    rays, on_table = backproject(np.ones((240, 320)), CAMERA), np.zeros((240, 320), bool)
    on_table[40:200, 60:260] = True
    table = 1 / (rays @ (0.36, 0.48, 0.8) / 0.75 + 0.06 * rays[..., 0] * rays[..., 1])  # 0.75 m from the camera
    depth = np.where(on_table, table, 1.3 / (rays @ (-0.1, 0.6, 0.79)))
    depth[:20] = 0.2
    image = DepthImage(depth.astype(np.float32), CAMERA)
    support, floor = dominant_planes(image)
    assert support.distance == pytest.approx(np.median(depth[on_table]), rel=0.02) and floor.distance > 1.2
    assert support.share == pytest.approx(on_table.sum() / depth[20:].size, abs=0.02)
    np.testing.assert_allclose(support.heights(image)[20:], (0.75 * (1 - depth / table))[20:], atol=0.002)


def test_points_of_a_plane_are_near_it_in_inverse_depth() -> None:
    """Three of five points are on it, the others are less or more than 3 mm and 4 mm times the squared depth away."""
    sides = np.random.default_rng(0).choice([-1, 0, 0, 0, 1], (240, 320))
    for inverse, tolerance in ((0.5, 0.00475), (2.5, 0.02275)):
        for distance, share in ((0.95, 1.0), (1.3, 0.6)):
            image = DepthImage((1 / (inverse + distance * tolerance * sides)).astype(np.float32), CAMERA)
            assert dominant_planes(image)[0].share == pytest.approx(share, abs=0.02)


def test_pixels_of_another_colour_than_the_plane_around_are_left_out() -> None:
    for difference, left_out in ((9, 0), (11, 1)):  # of three channels: 27 and 33
        color = np.full((80, 80, 3), 100, np.uint8)
        color[40:42, 40:42] += np.uint8(difference)
        assert (_plane_color(color, np.ones((80, 80), bool))[3] == 0).sum() == left_out


def test_steps_are_where_neighbours_differ() -> None:
    """The slope between the neighbours of a pixel is 0.3 or 0.5 of the least step."""
    columns = np.arange(64)
    for inverse, least in ((2.0, 0.039), (0.5, 0.0165)):
        for step, slope, expected in ((0.96, 0, []), (1.04, 0.3, [31, 32]), (1.04, 0.5, [30, 31, 32, 33])):
            rows = np.tile(inverse + least * (step * (columns > 31) + slope / 2 * (columns - 31.5)), (48, 1))
            (steps, _), _ = _depth_edges(DepthImage((1 / rows).astype(np.float32), CAMERA))
            assert np.flatnonzero(steps[24]).tolist() == expected


def test_frames_without_things() -> None:
    """An empty table, boxes without a table or beside it, depth that is missing or out of range, or noise."""
    frame = render(APART[2:])
    beside = frame.depth * ((frame.label_image > 0) | (np.arange(320) < 160))
    noise = np.random.default_rng(0).integers(400, 2400, frame.depth.shape).astype(np.uint16)
    depths = [np.full_like(frame.depth, depth) for depth in (0, 100, 60000)] + [noise, beside]
    frames = [render([]), render(APART, plane=False), *(dataclasses.replace(frame, depth=depth) for depth in depths)]
    assert [segment_table(each).any() for each in frames] == [False] * 7


def assert_one_thing(frame: RGBDFrame, **changed: Any) -> None:
    """Assert that the only piece of a changed frame is its only box."""
    labels = segment_table(dataclasses.replace(frame, **changed))
    assert labels.max() == 1 and best_overlaps(labels, frame.label_image)[0] > 0.93


def test_soft_shadows_and_patterns_are_not_things() -> None:
    frame = render(APART[:1])
    row, column = np.mgrid[0:240, 0:320]
    shade = 1 - 0.4 * np.exp(-((row - 170) ** 2 + (column - 230) ** 2) / (2 * 25**2))
    assert_one_thing(frame, color=(frame.color * shade[..., None]).astype(np.uint8))
    squares = np.random.default_rng(0).integers(-40, 41, (40, 54, 1)).repeat(6, axis=0).repeat(6, axis=1)[:, :320]
    assert_one_thing(frame, color=(frame.color + squares).clip(0, 255).astype(np.uint8))


def test_the_top_of_a_frame_is_no_tray() -> None:
    """A picture frame of 38 cm x 44 cm has a connected top, which fills less than half of its hull."""
    across = [Box(0.0, y, (0.19, 0.02), 0.03, RED) for y in (-0.2, 0.2)]
    frame = render([*across, *(Box(x, 0.0, (0.02, 0.18), 0.03, RED) for x in (-0.17, 0.17))], 20)
    assert_one_thing(dataclasses.replace(frame, labels=(frame.label_image > 0).astype(np.int32)))


def test_a_deep_shadow_beside_a_thing_is_no_thing() -> None:
    frame = render([Box(0.0, 0.0, (0.06, 0.04), 0.12, YELLOW)])
    shadow = np.roll(frame.label_image, (4, 14), axis=(0, 1)).astype(bool) & (frame.label_image == 0)
    assert_one_thing(frame, color=np.where(shadow[..., None], frame.color * 0.3, frame.color).astype(np.uint8))


def test_a_part_without_depth_belongs_to_the_thing_that_it_borders_on() -> None:
    frame = render([Box(0.0, 0.0, (0.04, 0.04), 0.14, RED)])
    lower = (frame.label_image == 1) & (np.arange(240)[:, None] > np.nonzero(frame.label_image)[0].mean())
    assert_one_thing(frame, color=np.where(lower[..., None], np.uint8(25), frame.color), depth=frame.depth * ~lower)


def test_wall_sized_and_tiny_pieces_are_dropped() -> None:
    frame = render([Box(0.0, 0.3, (0.6, 0.02), 0.9, RED), Box(0.1, -0.05, (0.005, 0.005), 0.01, BLUE), APART[1]], 60)
    labels = segment_table(frame)
    assert best_overlaps(labels, frame.label_image)[2] > 0.94
    assert set(np.unique(labels[frame.label_image == 1])) == {0}


def test_depth_with_nan_and_holes() -> None:
    frame = render(APART)
    holes = np.random.default_rng(1).random(frame.depth.shape) < 0.1
    metres = np.where(holes, np.float32(np.nan), frame.depth_m)
    metres[:30] = np.inf
    labels = segment_table(dataclasses.replace(frame, depth=metres))
    assert (best_overlaps(labels, frame.label_image) > 0.92).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 2), (17, 400), (1, 4000)])
def test_images_of_few_pixels(size: tuple[int, int]) -> None:
    color, depth = np.full((*size, 3), 90, np.uint8), np.full(size, 900, np.uint16)
    assert segment_table(RGBDFrame(color, depth, None, Intrinsics(500.0, 500.0, 0.0, 0.0))).shape == size


def test_borders_are_refined_as_in_the_whole_image() -> None:
    """Only the part of the image around the pieces is flooded; a far piece makes it the whole image."""
    color = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    labels = label_image((1, 20, 30, 12, 30), shape=(48, 64), dtype=np.int32)
    alone = _refined(labels, color, 2)
    labels[0:4, 0:4], labels[44:48, 60:64] = 2, 3
    np.testing.assert_array_equal(alone == 1, _refined(labels, color, 2) == 1)
    assert not _refined(np.zeros_like(labels), color, 2).any()


@pytest.mark.parametrize(("hole", "is_filled"), [(8, True), (12, False)])
def test_small_holes_in_a_thing_are_filled(hole: int, is_filled: bool) -> None:
    mask = np.ones((20, 20), bool)
    mask[:2, :2] = False  # at the border, so that it is no hole
    whole, first = mask.copy(), 12 - hole // 2
    mask[first : first + hole, first : first + hole] = False
    np.testing.assert_array_equal(_without_holes(mask), whole if is_filled else mask)


def test_the_rim_of_thick_things_is_trimmed() -> None:
    thin, thick = (3, 70, 73, 10, 110), [(1, 5, 65, 10, 70), (257, 5, 65, 70, 110)]
    inner = [(label, top + 1, bottom - 1, left + 1, right - 1) for label, top, bottom, left, right in thick]
    labels, expected = (label_image(thin, *each, shape=(80, 120), dtype=np.int32) for each in (thick, inner))
    np.testing.assert_array_equal(_trimmed(labels, 3), expected)
