"""Crops of the views of a dataset: written beside it, resumed, reduced, and refused where they do not fit."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import files_of, run_thor2, write_box

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame
from training.objects.mesh import TexturedMesh
from training.objects.meshes import find_meshes, load_mesh
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import camera_pose, view_angles
from training.views import render_job
from training.views.crops import ViewCrops, quantized, rgbd_crop, stacked
from training.views.dataset import ViewDataset
from training.views.left_out import WithoutClasses
from training.views.render_job import render_crops, render_dataset

SIZE = 24


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    for name, size, color in (("brick", (0.1, 0.06, 0.2), (200, 40, 40)), ("box", (0.1, 0.1, 0.1), (40, 200, 90))):
        write_box(folder / f"{name}.ply", size, color)
    return folder


def render_command(meshes: Path, out: Path) -> list[object]:
    """Return the command that renders them, but for the size of the crops."""
    options = ("--azimuth-step", 180, "--polar-step", 90, "--workers", 1, "--illumination", "--copies", 1, "--quiet")
    return ["render", "--meshes", meshes, "--out", out, *options, "--crops"]


@pytest.fixture(scope="module")
def dataset(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> ViewDataset:
    out = tmp_path_factory.mktemp("views") / "views"
    assert run_thor2(*render_command(meshes, out), SIZE) == 0
    return ViewDataset.open(out)


def test_crops_are_those_of_the_rendered_views(meshes: Path, dataset: ViewDataset) -> None:
    """A source without the brick has those of the box."""
    mesh: TexturedMesh = load_mesh(meshes / "brick.ply")
    index = dataset.classes.index("brick")
    views, crops = dataset.read(index), dataset.read_crops(index, SIZE)
    assert len(views) == len(crops) and (views.copy == 1).sum() == (views.copy == 0).sum() > 0
    for row in np.flatnonzero(views.copy == 0):
        azimuth, polar = view_angles(180, 90)[views.view[row]]
        view = render_view(RayCaster([mesh]), camera_pose(azimuth, polar, mesh.centre))
        frame = RGBDFrame(view.color, view.depth, (view.depth > 0).astype(np.uint8), view.intrinsics)
        color, normals = quantized(rgbd_crop(frame, 1, SIZE))
        np.testing.assert_array_equal(crops.color[row], color)
        np.testing.assert_array_equal(crops.normals[row], normals)
    box = WithoutClasses(dataset, ["brick"]).read_crops(0, SIZE)
    np.testing.assert_array_equal(box.color, dataset.read_crops(1 - index, SIZE).color)


def test_crops_of_the_user_are_not_replaced(meshes: Path, dataset: ViewDataset, tmp_path: Path) -> None:
    copied = shutil.copytree(dataset.directory, tmp_path / "views", ignore=shutil.ignore_patterns("crops"))
    (copied / "crops").mkdir()
    for file in (dataset.directory / "crops").glob("*.npz"):
        (copied / "crops" / file.name).write_text("a user's")
    with pytest.raises(InputError, match="already contains"):
        render_crops(find_meshes(meshes), ViewDataset.open(copied), SIZE)
    assert all(file.read_text() == "a user's" for file in (copied / "crops").glob("*.npz"))


def test_interrupted_crops_resume_with_the_same_bytes(
    meshes: Path, dataset: ViewDataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The damaged file alone is written again; the dataset keeps its digest."""
    directory = dataset.directory / "crops"
    before, first = {**files_of(directory), "manifest.json": None}, min(directory.glob("*.npz"))
    first.write_bytes(first.read_bytes()[:-1])
    with pytest.raises(InputError, match="is missing or damaged"):
        dataset.read_crops(0, SIZE)
    written = []
    encode = render_job.crops.encode_crops
    monkeypatch.setattr(render_job.crops, "encode_crops", lambda crops: written.append(len(crops)) or encode(crops))
    again = render_command(meshes, dataset.directory)
    assert run_thor2(*again, SIZE) == 0
    assert len(written) == 1 and ViewDataset.open(dataset.directory).digest == dataset.digest
    assert {**files_of(directory), "manifest.json": None} == before
    assert run_thor2(*again, 0) == 2 and run_thor2(*again, 2 * SIZE) == 2


def test_crops_that_do_not_fit_are_refused(meshes: Path, dataset: ViewDataset, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"crops of {SIZE} pixels; expected at least 25"):
        dataset.read_crops(0, SIZE + 1)
    plain = render_dataset(find_meshes(meshes), tmp_path / "plain", 180, 90)
    with pytest.raises(InputError, match="has no crops.*--crops"):
        plain.read_crops(0, SIZE)
    render_crops(find_meshes(meshes), plain, 8)
    manifest = plain.directory / "crops" / "manifest.json"
    content = json.loads(manifest.read_text())
    manifest.write_text(json.dumps({**content, "dataset": "0"}))
    with pytest.raises(InputError, match="crops of other views"):
        plain.read_crops(0, 8)
    manifest.write_text("[]")
    with pytest.raises(InputError, match="manifest.json is damaged"):
        plain.read_crops(0, 8)


def test_reduced_crops_are_means_of_areas() -> None:
    """Up to the rounding of two passes, along rows and columns."""
    rng = np.random.default_rng(0)
    normals = rng.integers(-127, 128, (2, 8, 8, 3)).astype(np.int8)
    crops = ViewCrops(rng.integers(0, 256, (2, 8, 8, 3)).astype(np.uint8), normals)
    assert crops.reduced(8) is crops
    for values, reduced in ((crops.color, crops.reduced(4).color), (crops.normals, crops.reduced(4).normals)):
        means = values.reshape(2, 4, 2, 4, 2, 3).mean(axis=(2, 4))
        assert reduced.dtype == values.dtype and np.abs(reduced - means).max() <= 1
    assert len(stacked([], 5)) == 0 and stacked([], 5).size == 5
