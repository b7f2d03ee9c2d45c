"""Rendered views in memory and in folders: the same clouds, and damaged folders refused by name."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

from thor2_jax.errors import InputError
from training.builtin_objects import builtin_objects
from training.dataset import Cloud
from training.meshes import TexturedMesh
from training.view_files import read_view_folder, render_to_folder, render_views
from training.view_sphere import camera_pose, view_angles
from training.views import MIN_POINTS, view_cloud

OBJECTS = {name: builtin_objects()[name] for name in ("mug_blue", "screwdriver")}


def speck(radius: float) -> TexturedMesh:
    shape = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    colors = np.full((len(shape.faces), 3, 3), 9, np.uint8)
    return TexturedMesh(np.array(shape.vertices), np.array(shape.faces, np.int32), corner_colors=colors)


def check_same(one: dict[str, list[Cloud]], other: dict[str, list[Cloud]]) -> None:
    assert list(one) == list(other)
    for name in one:
        assert len(one[name]) == len(other[name])
        for (xyz, rgb), (other_xyz, other_rgb) in zip(one[name], other[name], strict=True):
            assert xyz.dtype == other_xyz.dtype == np.float32 and rgb.dtype == other_rgb.dtype == np.uint8
            assert np.array_equal(xyz, other_xyz) and np.array_equal(rgb, other_rgb)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rendered") / "deep" / "views"
    assert render_to_folder(OBJECTS, out, 60, 45) == {"mug_blue": (30, 0), "screwdriver": (30, 0)}
    return out


@pytest.fixture
def copied(written: Path, tmp_path: Path) -> Path:
    return shutil.copytree(written, tmp_path / "views")


def test_in_memory_as_in_the_folder(written: Path) -> None:
    seen: list[tuple[int, int]] = []
    views = render_views(OBJECTS, 60, 45, 1, lambda done, total: seen.append((done, total)))
    assert seen == [(k, 60) for k in range(1, 61)]
    check_same(views, read_view_folder(written))
    assert sorted(path.name for path in written.iterdir()) == ["manifest.json", "views-000.npz", "views-001.npz"]
    mesh, (azimuth, polar) = OBJECTS["screwdriver"], view_angles(60, 45)[8]
    expected = view_cloud(mesh, camera_pose(azimuth, polar, mesh.centre))
    check_same({"x": [views["screwdriver"][8]]}, {"x": [expected]})


def test_files_of_meshes_and_meshes_give_the_same(tmp_path: Path) -> None:
    colors = np.full((4, 3), 99, np.uint8)
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    trimesh.Trimesh(corners, faces, vertex_colors=colors, process=False).export(tmp_path / "corner.ply")
    mesh = TexturedMesh(
        corners.astype(np.float32).astype(np.float64), faces.astype(np.int32), corner_colors=colors[faces]
    )
    check_same(render_views({"a": tmp_path / "corner.ply"}, 180, 90), render_views({"a": mesh}, 180, 90))


def test_views_of_few_points_are_left_out_and_counted(tmp_path: Path) -> None:
    # A thin sheet, seen edge on from the side.
    sheet = speck(0.03)
    sheet.vertices[:, 2] *= 0.005
    assert render_to_folder({"sheet": sheet}, tmp_path / "views", 180, 90) == {"sheet": (4, 2)}
    manifest = json.loads((tmp_path / "views" / "manifest.json").read_text())
    assert manifest["objects"]["sheet"]["views"] == 4 and manifest["objects"]["sheet"]["left_out"] == 2
    clouds = read_view_folder(tmp_path / "views")["sheet"]
    assert len(clouds) == 4 and min(len(xyz) for xyz, _ in clouds) >= MIN_POINTS
    with pytest.raises(InputError, match="object 'speck': none of its 6 views has 30 points"):
        render_views({"speck": speck(0.003)}, 180, 90)


def test_odd_names(tmp_path: Path) -> None:
    name = "../a b/ü"
    render_to_folder({name: OBJECTS["mug_blue"]}, tmp_path / "views", 180, 90)
    assert list(read_view_folder(tmp_path / "views")) == [name]
    assert [path.name for path in tmp_path.iterdir()] == ["views"]


def test_bad_requests_write_nothing(tmp_path: Path) -> None:
    out = tmp_path / "views"
    (tmp_path / "bad.ply").write_text("not a mesh")
    for found, steps, workers, message in [
        ({}, (60, 45), 1, "found is empty"),
        (OBJECTS, (0, 45), 1, "azimuth_step"),
        (OBJECTS, (60, -45), 1, "polar_step"),
        (OBJECTS, (60, 45), 0, "workers"),
        ({**OBJECTS, "z": tmp_path / "bad.ply"}, (60, 45), 1, "bad.ply"),
        ({"z": tmp_path / "absent.ply"}, (60, 45), 1, "absent.ply: no such file"),
    ]:
        with pytest.raises(InputError, match=message):
            render_to_folder(found, out, *steps, workers)
        assert not out.exists()


def test_folders_in_use_are_kept(tmp_path: Path) -> None:
    (tmp_path / "views").mkdir()
    (tmp_path / "views" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        render_to_folder(OBJECTS, tmp_path / "views", 180, 90)
    with pytest.raises(InputError, match="exists already"):
        render_to_folder(OBJECTS, tmp_path / "views" / "mine.txt", 180, 90)
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["mine.txt"]


def test_an_interrupted_folder_is_refused(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_to_folder(OBJECTS, tmp_path / "views", 180, 90, 1, interrupt)
    assert [path.name for path in (tmp_path / "views").iterdir()] == ["views-000.npz"]
    with pytest.raises(InputError, match="no manifest.json; it is no folder of views, or rendering did not finish"):
        read_view_folder(tmp_path / "views")


def check_refused(folder: Path, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_view_folder(folder)
    assert "\n" not in str(caught.value)


def test_damaged_files(copied: Path) -> None:
    path = copied / "views-001.npz"
    whole = path.read_bytes()
    for content in (b"", b"noise", whole[: len(whole) // 2], whole[:-30]):
        path.write_bytes(content)
        check_refused(copied, "views-001.npz is missing or damaged")
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 255
    path.write_bytes(flipped)
    check_refused(copied, "views-001.npz is missing or damaged")
    path.unlink()
    check_refused(copied, "views-001.npz is missing or damaged")
    shutil.copy(copied / "views-000.npz", path)
    check_refused(copied, "views-001.npz does not hold the 30 views")


def test_arrays_that_do_not_fit(copied: Path) -> None:
    path = copied / "views-000.npz"
    with np.load(path) as file:
        arrays = dict(file)
    for key, value in [
        ("xyz", arrays["xyz"].astype(np.float64)),
        ("xyz", arrays["xyz"][:-1]),
        ("xyz", np.full_like(arrays["xyz"], np.nan)),
        ("rgb", arrays["rgb"].astype(np.int16)),
        ("counts", arrays["counts"] + 1),
        ("counts", arrays["counts"] * 0),
    ]:
        np.savez(path, **{**arrays, key: value})
        check_refused(copied, "views-000.npz does not hold")
    np.savez(path, counts=arrays["counts"], xyz=arrays["xyz"])
    check_refused(copied, "views-000.npz is missing or damaged")
    np.savez(path, **{**arrays, "rgb": np.array([{}], object)})
    check_refused(copied, "views-000.npz is missing or damaged")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "manifest.json is damaged"),
        ("[]", "manifest.json is damaged"),
        ("null", "manifest.json is damaged"),
        ("{}", "manifest.json is damaged"),
        ("[" * 100_000, "manifest.json is damaged"),
        ('{"format": 1, "sigma_s": 2.5, "voxel": 0.01, "objects": {"a": {}}}', "manifest.json is damaged"),
        ('{"format": 1, "sigma_s": 2.5, "voxel": 0.01, "objects": {}}', "lists no objects"),
        ('{"format": 2, "sigma_s": 2.5, "voxel": 0.01, "objects": {}}', "format 2; this version reads 1"),
        ('{"format": 1, "sigma_s": 1.5, "voxel": 0.01, "objects": {}}', "sigma_s and voxel"),
    ],
)
def test_manifests_that_do_not_fit(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "manifest.json").write_text(content)
    check_refused(tmp_path, message)


def test_folders_that_are_none(tmp_path: Path) -> None:
    check_refused(tmp_path / "absent", "absent is no folder")
    check_refused(tmp_path, "no manifest.json")
