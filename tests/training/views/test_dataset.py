"""Datasets of views: rendered views are read back, interrupted rendering resumes, damaged files are refused by name."""

import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np
import pytest
import safetensors.numpy
from commands import Command
from failures import Interrupted
from refusals import assert_refused
from rendered_objects import write_box
from small_clouds import CLOSED, random_clouds
from written_files import files_of, files_of_the_user

import thor2_jax
from thor2_jax.errors import InputError
from thor2_jax.files import locked
from thor2_jax.types import Cloud
from training.augmentation.augmentations import Augmentations
from training.augmentation.sensing import Illumination
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh
from training.storage.jobs import MANIFEST, write_checked
from training.storage.workers import local_workers
from training.views.dataset import Shard, ViewDataset, encode, remove_views, render_dataset
from training.views.mesh_views import COORDINATE_STEP, MAX_VIEW_LENGTH, RenderJob, render_views
from training.views.normalized_views import NormalizedViews, normalize_views, padded_batches

NAMES = ("screwdriver", "tennis_ball")
OBJECTS = {name: builtin_objects()[name] for name in NAMES}
JOB = RenderJob(OBJECTS, 180, 90)
"""6 views an object: of 4 and 2 with the shards of these tests."""


@pytest.fixture(scope="module", autouse=True)
def small_shards_on_a_cpu() -> Iterator[None]:
    """An accelerator may swap nearly equal sides of a cloud that it normalizes in a batch instead of alone."""
    with jax.default_device(jax.devices("cpu")[0]), pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.views.mesh_views.CLOUDS_PER_SHARD", 4)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of a job that nothing interrupted."""
    out = tmp_path_factory.mktemp("whole") / "deep" / "views"
    render_dataset(JOB, out)
    return out


@pytest.fixture
def copied(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "views")


def resized(factor: float) -> TexturedMesh:
    ball = OBJECTS["tennis_ball"]
    return dataclasses.replace(ball, vertices=ball.vertices * factor)


@pytest.mark.slow
def test_workers_give_equal_files(whole: Path, tmp_path: Path) -> None:
    render_dataset(JOB, tmp_path / "views", local_workers(2))
    assert files_of(tmp_path / "views") == files_of(whole)


def test_rendering_resumes(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call continues the one before, and is interrupted before or after a file is moved to its name.

    The files are the first manifest, then the surfaces and four shards, each with a manifest that lists it. Until it is
    listed, a file is written again.
    """
    replace, out, left = os.replace, tmp_path / "views", 0

    def stopping(source: Path, target: Path) -> None:
        nonlocal left
        left -= 2
        if left == -1:
            raise Interrupted
        replace(source, target)
        if left == 0:
            raise Interrupted

    monkeypatch.setattr(os, "replace", stopping)
    for call, steps in enumerate((1, 2, *(1, 2, 3, 4) * 5)):
        stored = json.loads(files_of(out).get(MANIFEST, '{"views": 0}'))
        left, seen = steps, list[tuple[str, int, int]]()
        with pytest.raises(Interrupted):
            render_dataset(JOB, out, progress=lambda *step: seen.append(step[:3]))  # noqa: B023
        first = ("render", stored["views"], 12) if "surfaces" in stored else ("surfaces", 0, 2)
        assert seen[:1] == ([first] if call > 1 else [])
        expected = "is not a directory" if call == 0 else MANIFEST  # a directory without files is removed
        with pytest.raises(InputError, match=expected) if call < 21 else contextlib.nullcontext():
            ViewDataset.open(out)
    assert files_of(out) == files_of(whole)


def changed(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def test_only_damaged_and_missing_shards_are_rendered_again(whole: Path, copied: Path) -> None:
    missing = copied / "0001-0000.safetensors"
    for bad in (copied / "0000-0001.safetensors", copied / "surfaces.safetensors"):
        content = bytearray(bad.read_bytes())
        content[1000] ^= 1
        bad.write_bytes(content)
    missing.unlink()
    with pytest.raises(InputError, match="surfaces.safetensors is missing or damaged; repeat `thor2 render`"):
        _ = ViewDataset.open(copied).surfaces
    before = changed(copied)
    render_dataset(JOB, copied)
    assert files_of(copied) == files_of(whole)
    same = {name for name, time in changed(copied).items() if before.get(name) == time}
    assert same - {".lock"} == {"0000-0000.safetensors", "0001-0001.safetensors"}
    before = changed(copied)
    with locked(copied):
        assert_refused(str(copied), render_dataset, JOB, copied)
    assert len(render_dataset(JOB, copied)) == 12
    assert changed(copied) == before | {".lock": changed(copied)[".lock"]}


def test_a_dataset_of_an_earlier_version_stays_as_it_is(copied: Path) -> None:
    """It has neither surfaces nor cameras."""
    (copied / "surfaces.safetensors").unlink()
    dataset, shards = ViewDataset.open(copied), list[Shard]()
    for shard in dataset.shards:
        arrays = safetensors.numpy.load((copied / shard.file).read_bytes())
        del arrays["camera"]
        digest = write_checked(copied / shard.file, safetensors.numpy.save(arrays))
        shards.append(dataclasses.replace(shard, sha256=digest))
    old = dataclasses.replace(dataset, shards=tuple(shards), surfaces_sha256=None)
    (copied / MANIFEST).write_text(old.manifest)
    before = files_of(copied)
    dataset = render_dataset(JOB, copied)
    assert files_of(copied) == before
    assert dataset.surfaces is None and np.array_equal(dataset.read(1).camera, np.zeros((2, 3)))


def test_another_job_is_refused(copied: Path) -> None:
    before = files_of(copied)
    ball, screwdriver = OBJECTS["tennis_ball"], OBJECTS["screwdriver"]
    moved = dataclasses.replace(ball, vertices=ball.vertices + 1e-3)
    painted = dataclasses.replace(screwdriver, textures=tuple(texture ^ 1 for texture in screwdriver.textures))
    for changes, message in (
        ({"azimuth_step": 90}, "azimuth_step 180.0, not 90.0"),
        ({"polar_step": 45}, "polar_step 90.0, not 45.0"),
        ({"meshes": OBJECTS | {"tennis_ball": moved}}, r"objects\[\d\].mesh "),
        ({"meshes": OBJECTS | {"screwdriver": painted}}, r"objects\[\d\].mesh "),
        ({"meshes": OBJECTS | {"apple": moved}}, r"objects\[2\] null, not \{"),
        ({"meshes": dict(reversed(OBJECTS.items()))}, r"objects\[0\].name "),
    ):
        assert_refused(f"{copied} .*{message}", render_dataset, dataclasses.replace(JOB, **changes), copied)
        assert files_of(copied) == before


def test_a_mesh_that_changes_during_the_rendering(tmp_path: Path) -> None:
    objects = dict(OBJECTS)

    def change(stage: str, *_: object) -> None:
        if stage == "render":
            objects["tennis_ball"] = resized(1.1)

    assert_refused("'tennis_ball' has changed", render_dataset, RenderJob(objects, 180, 90), tmp_path, progress=change)


def test_augmentations_are_part_of_the_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.views.mesh_views.CLOUDS_PER_SHARD", 8)
    out, light = tmp_path / "views", Augmentations(illumination=Illumination(), copies=2)
    job = RenderJob({"ball": resized(1)}, 90, 90, light, 1)
    dataset = render_dataset(job, out)
    assert len(dataset) == 36 and dataset.record["job"]["variations"]["seed"] == 1
    assert [shard.views for shard in dataset.shards] == [6] * 6
    views = dataset.read(1)
    assert views.view.tolist() == [2, 2, 2, 3, 3, 3] and views.copy.tolist() == [0, 1, 2] * 2
    for changes in ({"augmentations": None}, {"seed": 2}, {"augmentations": dataclasses.replace(light, copies=3)}):
        assert_refused("variations", render_dataset, dataclasses.replace(job, **changes), out)
    off = render_dataset(dataclasses.replace(job, augmentations=Augmentations(), seed=2), tmp_path / "off")
    assert len(off) == 12 and off.record["job"]["variations"] is None
    assert_refused("variations null, not {", render_dataset, job, tmp_path / "off")


def test_views_of_few_points_are_left_out_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One shard keeps none of its views; objects may have any name."""
    monkeypatch.setattr("training.views.mesh_views.CLOUDS_PER_SHARD", 2)
    sheet, name = resized(1), "../a b/ü"
    sheet.vertices[:, 2] *= 0.005  # seen edge on from the side
    dataset = render_dataset(RenderJob({name: sheet}, 180, 90), tmp_path / "views")
    assert [(shard.views, shard.left_out) for shard in dataset.shards] == [(2, 0), (0, 2), (2, 0)]
    assert [dataset.read(k).view.tolist() for k in range(3)] == [[0, 1], [], [4, 5]]
    assert dataset.record["left_out"] == 2 and dataset.read(1).xyz.shape == (0, 3)
    assert dataset.classes == (name,) and [path.name for path in tmp_path.iterdir()] == ["views"]


def test_bad_requests_write_nothing(tmp_path: Path) -> None:
    out = tmp_path / "views"
    (tmp_path / "bad.ply").write_text("not a mesh")
    for changes, message in (
        ({"meshes": {}}, "meshes is empty"),
        ({"seed": -1}, "seed is -1"),
        ({"meshes": {**OBJECTS, "z": tmp_path / "bad.ply"}}, "bad.ply"),
        ({"meshes": {"speck": resized(0.1)}}, "object 'speck'"),
        ({"meshes": {"door": resized(20)}}, "object 'door' .*2.32 m"),
    ):
        assert_refused(message, render_dataset, dataclasses.replace(JOB, **changes), out)
        assert not out.exists()
    assert_refused(f"out: {tmp_path} already contains bad.ply", render_dataset, JOB, tmp_path)
    (tmp_path / MANIFEST).write_text('{"format": 1}')
    assert_refused("manifest.json has format 1; expected 2", render_dataset, JOB, tmp_path)
    assert files_of(tmp_path) == {"bad.ply": b"not a mesh", MANIFEST: b'{"format": 1}'}


def test_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command, refused: Command) -> None:
    write_box(tmp_path / "meshes" / "box.ply", (0.06, 0.06, 0.06))
    command = ("render", "--meshes", tmp_path / "meshes", "--out", tmp_path / "views", "--azimuth-step", 180)
    for _ in range(2):  # it may be repeated
        assert "views: 6 (objects: 1, left out: 0)" in printed(*command, "--polar-step", 90, "--workers", 1)
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "'.[cluster]'" in refused(*command, "--engine", "ray")


def views_of(clouds: list[Cloud]) -> NormalizedViews:
    return normalize_views(clouds, 3, range(len(clouds)), [0] * len(clouds), CLOSED)


def test_only_what_was_rendered_is_removed(copied: Path) -> None:
    users = [copied / "crops" / "mine.npz", copied / "notes.txt"]
    with files_of_the_user(*users):
        remove_views(copied)
        assert sorted(path for path in copied.rglob("*") if path.is_file()) == users
    with files_of_the_user(*users, copied / "manifest.json"):
        remove_views(copied)


def test_views_are_read_normalized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Coordinates differ from those of `view_normalize`, cloud by cloud, by at most half a step."""
    monkeypatch.setattr("training.views.mesh_views.CLOUDS_PER_SHARD", 30)
    dataset = render_dataset(RenderJob(OBJECTS, 60, 45), tmp_path)
    assert dataset.classes == NAMES and [(shard.label, shard.views) for shard in dataset.shards] == [(0, 30), (1, 30)]
    for index, (name, clouds) in enumerate(render_views(OBJECTS, 60, 45).items()):
        views = dataset.read(index)
        assert dataset.classes[views.label] == name
        assert views.view.tolist() == list(range(30)) and not views.copy.any()
        assert views.counts.tolist() == [len(xyz) for xyz, _ in clouds]
        for (xyz, rgb), cloud in list(zip(views.clouds(), clouds, strict=True))[::10]:
            normal = thor2_jax.view_normalize(thor2_jax.PointClouds.pack([cloud]), CLOSED)
            assert np.abs(xyz - np.asarray(normal.points)[0, : len(xyz)]).max() <= COORDINATE_STEP / 2 * 1.02
            assert np.array_equal(rgb, cloud[1])
        for (xyz, _), camera, cloud in zip(views.clouds(), views.camera, clouds, strict=True):
            distance = np.linalg.norm(xyz.astype(np.float64) - camera, axis=1)
            np.testing.assert_allclose(distance, CLOSED.sigma_s * np.linalg.norm(cloud[0], axis=1), atol=1e-4)
        assert np.array_equal(views.xyz, views_of(clouds).xyz)
    record = json.loads(json.dumps(dataset.record))
    assert record["digest"] == dataset.digest == hashlib.sha256((tmp_path / MANIFEST).read_bytes()).hexdigest()
    assert record["views"] == 60 and record["left_out"] == 0 and record["job"]["variations"] is None
    assert [entry["name"] for entry in record["job"]["objects"]] == list(OBJECTS)


def test_empty_views_and_views_beyond_the_range() -> None:
    nothing = views_of([])
    assert len(nothing) == 0 and nothing.xyz.shape == (0, 3) and nothing.clouds() == []
    assert len(encode(nothing)) > 0
    line = np.linspace(0, 1, 50, dtype=np.float32)[:, None] * np.array([0, 0, 1], np.float32)
    rgb = np.zeros((50, 3), np.uint8)
    assert views_of([(line * np.float32(MAX_VIEW_LENGTH / 2.5), rgb)]).xyz.max() == MAX_VIEW_LENGTH
    assert_refused("4.05 scaled units", views_of, [(line, rgb), (line * np.float32(1.62), rgb)])


def test_padded_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.views.normalized_views.CLOUDS_PER_BATCH", 2)
    clouds = random_clouds(0, (3, 2100, 5))
    batches = list(padded_batches(clouds))
    assert [count for count, _ in batches] == [2, 1]
    assert [batch.mask.shape for _, batch in batches] == [(2, 4096), (2, 2048)]
    assert [batch.mask.sum(axis=1).tolist() for _, batch in batches] == [[3, 2100], [5, 0]]
    assert list(padded_batches([])) == []


def check_refused(directory: Path, message: str) -> None:
    assert_refused(f"{directory}.*{message}", lambda: ViewDataset.open(directory).read(1))


def test_incomplete_and_other_datasets_are_refused(copied: Path) -> None:
    """The message has the name of the file and the reason; tests/fuzz/test_tables.py has all kinds of damage."""
    path = copied / "0000-0001.safetensors"
    for damage in (lambda: shutil.copy(copied / "0000-0000.safetensors", path), path.unlink):
        damage()
        check_refused(copied, "0000-0001.safetensors is missing or damaged")
    assert len(ViewDataset.open(copied).read(0)) == 4
    dataset, path = ViewDataset.open(copied), copied / MANIFEST
    path.write_text(dataclasses.replace(dataset, job={**dataset.job, "descriptor_version": 99}).manifest)
    check_refused(copied, "descriptor version 99")
    path.write_text(dataclasses.replace(dataset, shards=dataset.shards[:1]).manifest)
    check_refused(copied, "1 of 4 shards")
    path.write_text(path.read_text().replace('"label": 0', '"label": 1'))
    check_refused(copied, "manifest.json is damaged")
    path.unlink()
    check_refused(copied, "manifest.json cannot be read")
    check_refused(copied / "absent", "is not a directory")
