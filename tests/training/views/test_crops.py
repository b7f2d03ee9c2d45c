"""Crops of colour and normals, against planes, spheres, SciPy and OpenCV, and those of the views of a dataset."""

import dataclasses
import json
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import pytest
from commands import STEPS, run_thor2
from refusals import assert_refused
from rendered_objects import write_box
from scipy.ndimage import generic_filter
from written_files import files_of, files_of_the_user

import thor2_jax as thor2
from training.objects.meshes import find_meshes, load_mesh
from training.protocol import DEFAULT
from training.rendering.camera import RayCaster, camera_pose, view_angles
from training.train_job import TrainJob, run_train_job
from training.views.crops import CROP_SIZE, ViewCrops, crops_of, fill_depth, rgbd_crop, surface_normals
from training.views.dataset import ViewDataset, render_crops, render_dataset
from training.views.mesh_views import RenderJob, ViewTask
from training.views.normalized_views import WithoutClasses

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
    color, normals = rgbd_crop(frame, 3, size)
    assert color.shape == normals.shape == (size, size, 3)
    assert (color.dtype, normals.dtype) == (np.uint8, np.int8)
    shown = normals.any(axis=-1)
    assert shown[size // 2, size // 2] and (color[shown] == [255, 51, 0]).all() and not color[~shown].any()
    np.testing.assert_array_equal(normals[shown], np.tile(np.rint(127 * normal), (shown.sum(), 1)))
    depth = np.rint(100_000 * np.where(box(4, 10, 30, 18), frame.depth, 0)).astype(np.uint32)
    labels, scaled = (depth > 0).astype(np.uint8), dataclasses.replace(CAMERA, depth_scale=100_000)
    view = rgbd_crop(thor2.RGBDFrame(frame.color, depth, labels, scaled), 1, size)
    np.testing.assert_array_equal(view, (color, normals))


def test_crop_is_centred_and_fills_the_square() -> None:
    """A box of 30 x 18 pixels fills the height, with margins of 6 pixels; the frame's border is no limit.

    Holes do not change the normals of the plane, and a single pixel looks at the camera.
    """
    for mask in (box(4, 10, 30, 18), box(0, 0, 30, 18), box(18, 46, 30, 18)):
        frame = plane_frame((0, 0, -1), mask)
        frame.depth[20:30, 12:20] = 0
        _, normals = rgbd_crop(frame, 3, 30)
        shown = np.pad(np.ones((30, 18), bool), ((0, 0), (6, 6)))
        np.testing.assert_array_equal(normals, np.where(shown[..., None], [0, 0, -127], 0))
    _, normals = rgbd_crop(plane_frame((0, 0, -1), box(3, 60, 1, 1)), 3, 2)
    ray = np.array([(60 - CAMERA.cx) / CAMERA.fx, (3 - CAMERA.cy) / CAMERA.fy, 1])
    np.testing.assert_array_equal(normals[0, 0], np.rint(-127 * ray / np.linalg.norm(ray)))


def test_enlarged_mask_matches_opencv() -> None:
    mask = cv2.circle(np.zeros((48, 64), np.uint8), (30, 24), 15, 1, -1).astype(bool)
    _, normals = rgbd_crop(plane_frame((0, 0, -1), mask), 3, 124)
    coverage = cv2.resize(mask[9:40, 15:46].astype(np.float32), (124, 124), interpolation=cv2.INTER_LINEAR)
    decided = np.abs(coverage - 0.5) > 1e-3
    np.testing.assert_array_equal(normals.any(axis=-1)[decided], coverage[decided] > 0.5)


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


SIZE = 24


def render_command(meshes: Path, out: Path) -> list[object]:
    """Return the command that renders them, but for the size of the crops."""
    options = (*STEPS, "--illumination", "--copies", 1, "--quiet")
    return ["render", "--meshes", meshes, "--out", out, *options, "--crops"]


@pytest.fixture(scope="module")
def dataset(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> ViewDataset:
    out = tmp_path_factory.mktemp("views") / "views"
    assert run_thor2(*render_command(meshes, out), SIZE) == 0
    return ViewDataset.open(out)


def test_crops_are_those_of_the_rendered_views(meshes: Path, dataset: ViewDataset) -> None:
    """The brick is the second class, and the only one of a dataset without the first class."""
    mesh = load_mesh(meshes / "brick.ply")
    index = dataset.classes.index("brick")
    views, crops = dataset.read(index), dataset.read_crops(index, SIZE)
    assert len(views) == len(crops) and (views.copy == 1).sum() == (views.copy == 0).sum() > 0
    for row in np.flatnonzero(views.copy == 0):
        azimuth, polar = view_angles(180, 90)[views.view[row]]
        view = RayCaster([mesh]).render(camera_pose(azimuth, polar, mesh.centre))
        color, normals = rgbd_crop(view.frame, 1, SIZE)
        np.testing.assert_array_equal(crops.color[row], color)
        np.testing.assert_array_equal(crops.normals[row], normals)
    alone = WithoutClasses(dataset, [dataset.classes[0]])
    assert index == 1 and np.array_equal(alone.read_crops(0, SIZE).color, crops.color)


def test_views_without_pixels_have_no_crop(tmp_path: Path) -> None:
    sheet = load_mesh(write_box(tmp_path / "sheet.ply", (0.1, 0.1, 1e-6)))
    from_above_and_edge_on = np.array([[0, 0], [0, np.pi / 2]])
    assert crops_of(ViewTask("sheet", sheet, from_above_and_edge_on), SIZE).keys() == {(0, 0)}


def test_interrupted_crops_resume(meshes: Path, dataset: ViewDataset) -> None:
    """The damaged file alone is written again; the dataset keeps its digest."""
    directory = dataset.directory / "crops"
    before, first = files_of(directory), min(directory.glob("*.npz"))
    first.write_bytes(first.read_bytes()[:-1])
    assert_refused("is missing or damaged", dataset.read_crops, 0, SIZE)
    again = render_command(meshes, dataset.directory)
    with mock.patch.object(ViewCrops, "stacked", wraps=ViewCrops.stacked) as rendered:
        assert run_thor2(*again, SIZE) == 0
    assert rendered.call_count == 1 and ViewDataset.open(dataset.directory).digest == dataset.digest
    assert files_of(directory) == before
    assert run_thor2(*again, 0) == 2 and run_thor2(*again, 2 * SIZE) == 2


def test_crops_that_do_not_fit_are_refused(meshes: Path, dataset: ViewDataset, tmp_path: Path) -> None:
    assert_refused(f"crops of {SIZE} pixels; expected at least 25", dataset.read_crops, 0, SIZE + 1)
    job = RenderJob(find_meshes(meshes), 180, 90)
    plain = render_dataset(job, tmp_path / "plain")
    assert_refused("has no crops.*--crops", plain.read_crops, 0, SIZE)
    training = TrainJob(tmp_path / "run", DEFAULT, dataset=plain.directory, baselines=["vit-cnn-small"])
    assert_refused("has no crops.*--crops", run_train_job, training, lambda *_: pytest.fail("work began"))
    with files_of_the_user(users := plain.directory / "crops" / "0000-0000.npz"):
        assert_refused("already contains", render_crops, job, plain, 8)
    users.unlink()
    render_crops(job, plain, 8)
    manifest = plain.directory / "crops" / "manifest.json"
    other = json.loads(manifest.read_text()) | {"dataset": "0"}
    for content, message in ((other, "crops of other views"), ([], "manifest.json is damaged")):
        manifest.write_text(json.dumps(content))
        assert_refused(message, plain.read_crops, 0, 8)
        assert_refused("dataset", render_crops, job, plain, 8)


def test_reduced_crops_are_means_of_areas() -> None:
    """Up to the rounding of two passes, along rows and columns."""
    rng = np.random.default_rng(0)
    normals = rng.integers(-127, 128, (2, 8, 8, 3)).astype(np.int8)
    crops = ViewCrops(rng.integers(0, 256, (2, 8, 8, 3)).astype(np.uint8), normals)
    assert crops.reduced(8) is crops
    for values, reduced in ((crops.color, crops.reduced(4).color), (crops.normals, crops.reduced(4).normals)):
        means = values.reshape(2, 4, 2, 4, 2, 3).mean(axis=(2, 4))
        assert reduced.dtype == values.dtype and np.abs(reduced - means).max() <= 1
    assert len(ViewCrops.stacked([], 5)) == 0 and ViewCrops.stacked([], 5).color.shape[1] == 5
