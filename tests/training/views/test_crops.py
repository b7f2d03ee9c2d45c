"""Crops of colour and surface normals, against planes, spheres, SciPy and OpenCV."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.ndimage import generic_filter

import thor2_jax as thor2
from thor2_jax.errors import InputError
from training.views.crops import CROP_SIZE, fill_depth, rgbd_crop, surface_normals

CAMERA = thor2.Intrinsics(100.0, 110.0, 31.5, 23.5)


def plane_frame(normal: tuple[float, float, float], mask: np.ndarray) -> thor2.RGBDFrame:
    """Return a frame of the plane through (0, 0, 0.8 m) with this normal, red in the mask and blue elsewhere."""
    rows, columns = np.indices(mask.shape)
    rays = np.stack([(columns - CAMERA.cx) / CAMERA.fx, (rows - CAMERA.cy) / CAMERA.fy, np.ones(mask.shape)], axis=-1)
    depth = (0.8 * normal[2] / (rays @ np.array(normal))).astype(np.float32)
    color = np.where(mask[..., None], np.array([255, 51, 0]), np.array([0, 0, 255])).astype(np.uint8)
    return thor2.RGBDFrame(color, depth, mask.astype(np.uint8) * 3, CAMERA)


def box(top: int, left: int, height: int, width: int) -> np.ndarray:
    mask = np.zeros((48, 64), bool)
    mask[top : top + height, left : left + width] = True
    return mask


@pytest.mark.parametrize("size", [1, 7, CROP_SIZE])
def test_crop_of_a_plane(size: int) -> None:
    """A tilted plane has its normal everywhere, up to the rim, and no colour of the background.

    Neither the depth unit nor the neighbours of an instance matter: rendered views are cropped alike.
    """
    normal = np.array([0.48, -0.36, -0.8])
    frame = plane_frame(tuple(normal), box(4, 10, 30, 18))
    crop = rgbd_crop(frame, 3, size)
    assert crop.color.shape == crop.normals.shape == (size, size, 3)
    assert crop.color.dtype == crop.normals.dtype == np.float32
    np.testing.assert_allclose(crop.color[crop.mask], np.tile([1, 0.2, 0], (crop.mask.sum(), 1)), atol=1e-5)
    np.testing.assert_allclose(crop.normals[crop.mask], np.tile(normal, (crop.mask.sum(), 1)), atol=1e-3)
    assert not crop.color[~crop.mask].any() and not crop.normals[~crop.mask].any()
    depth = np.rint(100_000 * np.where(box(4, 10, 30, 18), frame.depth, 0)).astype(np.uint32)
    labels, scaled = (depth > 0).astype(np.uint8), dataclasses.replace(CAMERA, depth_scale=100_000)
    view = rgbd_crop(thor2.RGBDFrame(frame.color, depth, labels, scaled), 1, size)
    np.testing.assert_array_equal(view.color, crop.color)
    np.testing.assert_allclose(view.normals, crop.normals, atol=1e-3)


def test_crop_is_centred_and_fills_the_square() -> None:
    """A box of 30 x 18 pixels fills the height, with margins of 6 pixels; the frame's border is no limit.

    Holes do not change the normals of the plane, and a single pixel looks at the camera.
    """
    for mask in (box(4, 10, 30, 18), box(0, 0, 30, 18), box(18, 46, 30, 18)):
        frame = plane_frame((0, 0, -1), mask)
        frame.depth[20:30, 12:20] = 0
        crop = rgbd_crop(frame, 3, 30)
        np.testing.assert_array_equal(crop.mask, np.pad(np.ones((30, 18), bool), ((0, 0), (6, 6))))
        np.testing.assert_allclose(crop.normals[crop.mask], np.tile([0, 0, -1], (30 * 18, 1)), atol=1e-6)
    crop = rgbd_crop(plane_frame((0, 0, -1), box(3, 60, 1, 1)), 3, 2)
    ray = np.array([(60 - CAMERA.cx) / CAMERA.fx, (3 - CAMERA.cy) / CAMERA.fy, 1])
    np.testing.assert_allclose(crop.normals[0, 0], -ray / np.linalg.norm(ray), atol=1e-6)


def test_enlarged_mask_matches_opencv() -> None:
    mask = cv2.circle(np.zeros((48, 64), np.uint8), (30, 24), 15, 1, -1).astype(bool)
    crop = rgbd_crop(plane_frame((0, 0, -1), mask), 3, 124)
    coverage = cv2.resize(mask[9:40, 15:46].astype(np.float32), (124, 124), interpolation=cv2.INTER_LINEAR)
    decided = np.abs(coverage - 0.5) > 1e-3
    np.testing.assert_array_equal(crop.mask[decided], coverage[decided] > 0.5)


def test_normals_of_a_sphere() -> None:
    center, radius = np.array([0.02, -0.01, 0.6]), 0.1
    rows, columns = np.indices((240, 320))
    rays = np.stack([(columns - 160) / 500, (rows - 120) / 500, np.ones(rows.shape)], axis=-1)
    b, c = rays @ center, center @ center - radius**2
    root = b**2 - (rays**2).sum(axis=-1) * c
    mask = root > 0
    points = rays * np.where(mask, (b - np.sqrt(np.maximum(root, 0))) / (rays**2).sum(axis=-1), 0)[..., None]
    truth = (points - center) / radius
    cosine = (surface_normals(points, mask) * truth).sum(axis=-1)
    steep = (-truth * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    assert cosine[mask & (steep > 0.3)].min() > np.cos(np.radians(3))
    assert (surface_normals(points, mask)[mask] * rays[mask]).sum(axis=-1).max() < 0


def test_filling_matches_scipy() -> None:
    """Holes of one pass have the median of their window; known depths and the background stay."""
    rng = np.random.default_rng(0)
    mask = np.ones((12, 15), bool)
    mask[:, -2:] = False
    depth = rng.uniform(0.5, 0.6, mask.shape).astype(np.float32)
    holes = (rng.random(mask.shape) < 0.3) & mask
    known = np.where(mask & ~holes, depth, np.nan)
    medians = generic_filter(known, np.nanmedian, size=5, mode="constant", cval=np.nan)
    filled = fill_depth(np.where(holes, 0, depth), mask)
    np.testing.assert_allclose(filled, np.where(mask, np.where(holes, medians, depth), 0), rtol=1e-6)
    # A part in which only one row is known, and another one without any depth.
    mask, depth = box(0, 0, 40, 20) | box(0, 40, 10, 10), np.where(box(0, 0, 1, 20), np.float32(0.7), 0)
    np.testing.assert_array_equal(fill_depth(depth, mask), np.where(mask, np.float32(0.7), 0))


def test_instances_that_cannot_be_cropped_are_refused() -> None:
    frame = plane_frame((0, 0, -1), box(4, 10, 30, 18))
    empty = thor2.RGBDFrame(frame.color, frame.depth * (frame.labels == 0), frame.labels, CAMERA)  # type: ignore[operator]
    for bad, label, size, argument in ((frame, 2, 8, "label"), (frame, 0, 8, "label"), (frame, 3, 0, "size")):
        with pytest.raises(InputError, match=f"^{argument} is"):
            rgbd_crop(bad, label, size)
    with pytest.raises(InputError, match="^label 3 has no depth"):
        rgbd_crop(empty, 3)
