"""Simulated cameras: each effect by itself against NumPy, SciPy or numbers by hand."""

import copy
import dataclasses

import numpy as np
import pytest
from image_files import label_image
from scipy.ndimage import binary_dilation, binary_erosion

import thor2_jax as thor2
from training.augmentation.simulated_cameras import REPORT, SimulatedCamera, through_camera
from training.rendering.camera import axial_deviation

INTRINSICS = thor2.Intrinsics(100.0, 100.0, 40.0, 30.0)
SQUARE = np.ones((3, 3), bool)
MASKS = label_image((1, 10, 40, 10, 30), (7, 20, 50, 30, 60), (9, 55, 57, 70, 72), shape=(60, 80))


def make_frame(depth: np.ndarray | None = None, labels: np.ndarray | None = None) -> thor2.RGBDFrame:
    color = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    depth = np.full((60, 80), 1000, np.uint16) if depth is None else depth
    return thor2.RGBDFrame(color, depth, labels, INTRINSICS)


def test_a_camera_is_deterministic_and_leaves_its_frame() -> None:
    depth = np.random.default_rng(1).integers(0, 2, (60, 80)).astype(np.uint16) * 900
    frame = make_frame(depth, MASKS)
    before = copy.deepcopy(frame)
    first, second = (through_camera(frame, REPORT[-1]) for _ in range(2))
    other = through_camera(frame, dataclasses.replace(REPORT[-1], name="another"))
    for name in ("color", "depth", "labels"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        np.testing.assert_array_equal(getattr(frame, name), getattr(before, name))
    assert (first.depth != other.depth).any() and (first.depth[depth == 0] == 0).all()
    assert (first.color != through_camera(make_frame(depth[::-1]), REPORT[-1]).color).any()  # noise of its own


def test_response_matches_hand_calculation() -> None:
    """0.5, 0.25 and 0.8 by gamma 2, gain 0.8 and warmth 0.1; then half of the distance from grey, and a veil."""
    frame = make_frame()
    frame.color[0, 0] = 128, 64, 204
    camera = SimulatedCamera("c", gamma=2.0, gain=0.8, saturation=0.5, warmth=0.1, veil=0.2)
    r, g, b = (128 / 255) ** 2 * 0.8 * 1.1, (64 / 255) ** 2 * 0.8, (204 / 255) ** 2 * 0.8 * 0.9
    grey = 0.299 * r + 0.587 * g + 0.114 * b
    expected = [255 * (0.8 * (grey + v) / 2 + 0.2) for v in (r, g, b)]
    assert through_camera(frame, camera).color[0, 0] == pytest.approx(expected, abs=0.51)


def test_color_is_shifted_down_and_right() -> None:
    frame = make_frame()
    seen = through_camera(frame, SimulatedCamera("c", shift=(3, -5)))
    np.testing.assert_array_equal(seen.color[3:, :-5], frame.color[:-3, 5:])
    np.testing.assert_array_equal(seen.color[0], seen.color[3])
    np.testing.assert_array_equal(seen.depth, frame.depth)


def test_blur_keeps_the_mean_and_noise_has_its_deviation() -> None:
    frame = make_frame()
    frame.color[:] = 128
    noisy = through_camera(frame, SimulatedCamera("c", noise=0.02)).color.astype(float)
    assert noisy.std() == pytest.approx(0.02 * 255, rel=0.03)
    frame.color[30, 40] = 228
    blurred = through_camera(frame, SimulatedCamera("c", blur=1.0)).color[30, 40]
    assert blurred == pytest.approx(128 + 100 / (2 * np.pi), abs=1)


def test_depth_noise_and_steps() -> None:
    depth = np.repeat(np.array([[500, 1500]], np.uint16), [40, 40], axis=1).repeat(60, axis=0)
    noisy = through_camera(make_frame(depth), SimulatedCamera("c", axial=3.0)).depth.astype(float)
    deviation = [3000 * axial_deviation(distance) for distance in (0.5, 1.5)]
    assert [noisy[:, :40].std(), noisy[:, 40:].std()] == pytest.approx(deviation, rel=0.04)
    coarse = through_camera(make_frame(depth + np.arange(80, dtype=np.uint16)), SimulatedCamera("c", step=6)).depth
    assert (coarse % 6 == 0).all() and abs(coarse[0] - (depth[0] + np.arange(80.0))).max() == 3


def test_depth_is_missing_along_edges() -> None:
    """Every edge pixel is lost with a share of 1: two columns at the step of 5 cm, none at that of 2 cm."""
    depth = np.full((60, 80), 1000, np.uint16)
    depth[:, 20:] = 1050
    depth[:, 50:] = 1070
    seen = through_camera(make_frame(depth), SimulatedCamera("c", edges=1.0))
    np.testing.assert_array_equal(seen.depth == 0, np.tile(np.isin(np.arange(80), (19, 20)), (60, 1)))
    assert 30 < (through_camera(make_frame(depth), SimulatedCamera("c", edges=0.5)).depth == 0).sum() < 90


def test_holes_have_no_depth() -> None:
    seen = through_camera(make_frame(), SimulatedCamera("c", holes=5, radius=6))
    assert 5 < (seen.depth == 0).sum() <= 5 * np.pi * 6**2
    np.testing.assert_array_equal(seen.color, make_frame().color)


@pytest.mark.parametrize("pixels", [1, 3])
def test_masks_are_eroded_and_dilated_like_morphology(pixels: int) -> None:
    """Masks do not grow into each other; the mask of four pixels would disappear and stays."""
    frame = make_frame(labels=MASKS)
    eroded = through_camera(frame, SimulatedCamera("c", mask=-pixels)).labels
    dilated = through_camera(frame, SimulatedCamera("c", mask=pixels)).labels
    for label in (1, 7):
        expected = binary_erosion(MASKS == label, SQUARE, iterations=pixels)
        np.testing.assert_array_equal(eroded == label, expected)
        grown = binary_dilation(MASKS == label, SQUARE, iterations=pixels)
        assert ((dilated == label) <= grown).all() and (dilated[MASKS == label] == label).all()
    assert (eroded == 9).sum() == 4
    np.testing.assert_array_equal(dilated > 0, binary_dilation(MASKS > 0, SQUARE, iterations=pixels))


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_masks_lack_what_is_near_the_table(tilt: float) -> None:
    """A step of 6 mm at the foot of a box of 10 cm is cut at 1 cm; a flat object of 6 mm keeps its eroded mask."""
    row, column = np.mgrid[:60, :80]
    ray = np.stack([(column - 40) / 100, (row - 30) / 100, np.ones((60, 80))], axis=-1)
    normal = np.array([0, -np.sin(tilt), -np.cos(tilt)])
    height = np.zeros((60, 80))
    height[20:40, 20:40] = 0.1
    height[34:40, 20:40] = 0.006
    height[20:40, 60:70] = 0.006
    height[:, 42:58] = np.random.default_rng(0).uniform(0.05, 0.2, (60, 16))  # half of the surroundings is no table
    depth = (height - np.cos(tilt)) / (ray @ normal)
    labels = label_image((1, 20, 40, 20, 40), (2, 20, 40, 60, 70), shape=(60, 80))
    frame = make_frame(depth.astype(np.float32), labels)
    seen = through_camera(frame, SimulatedCamera("c", mask=-1, base=0.01)).labels
    expected = label_image((1, 21, 34, 21, 39), (2, 21, 39, 61, 69), shape=(60, 80))
    np.testing.assert_array_equal(seen, expected)


def test_frames_without_table_labels_or_millimetres() -> None:
    """All pixels are masked: no table is found. Depth in metres and in tenths of millimetres becomes millimetres."""
    full = make_frame(labels=np.ones((60, 80), np.uint8))
    np.testing.assert_array_equal(through_camera(full, SimulatedCamera("c", base=0.01)).labels, full.labels)
    metres = dataclasses.replace(full, depth=np.full((60, 80), 1.2344, np.float32), labels=None)
    scale = dataclasses.replace(INTRINSICS, depth_scale=10000.0)
    tenths = dataclasses.replace(full, depth=np.full((60, 80), 12344, np.uint16), intrinsics=scale)
    for frame in (metres, tenths):
        seen = through_camera(frame, SimulatedCamera("c"))
        assert (seen.depth == 1234).all() and seen.intrinsics.depth_scale == 1000
    assert through_camera(metres, REPORT[-1]).labels is None
