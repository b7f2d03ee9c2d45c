"""Datasets of views: they are read as written, and damaged files are refused by name."""

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused
from small_clouds import random_clouds

import thor2_jax
from thor2_jax.types import Cloud
from training.objects.builtin_objects import builtin_objects
from training.views.dataset import Manifest, ViewDataset, encode, remove_views
from training.views.mesh_views import render_views
from training.views.normalized_views import (
    COORDINATE_STEP,
    MAX_VIEW_LENGTH,
    NormalizedViews,
    normalize_views,
    padded_batches,
)
from training.views.render_job import RenderJob, render_dataset

OBJECTS = {name: builtin_objects()[name] for name in ("tennis_ball", "screwdriver")}
CONFIG = thor2_jax.DescriptorConfig(homology="closed_form")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("rendered") / "views"
    render_dataset(RenderJob(OBJECTS, 60, 45), out)
    return out


@pytest.fixture
def copied(written: Path, tmp_path: Path) -> Path:
    return shutil.copytree(written, tmp_path / "views")


def views_of(clouds: list[Cloud]) -> NormalizedViews:
    return normalize_views(clouds, 3, range(len(clouds)), [0] * len(clouds), CONFIG)


def test_only_what_was_rendered_is_removed(copied: Path) -> None:
    (copied / "crops").mkdir()
    users = [copied / "notes.txt", copied / "crops" / "mine.npz"]
    for path in users:
        path.write_text("a user's")
    remove_views(copied)
    assert sorted(path for path in copied.rglob("*") if path.is_file()) == sorted(users[::-1])
    (copied / "manifest.json").write_text("a user's")
    remove_views(copied)
    assert all(path.read_text() == "a user's" for path in (*users, copied / "manifest.json"))


def test_views_are_read_normalized(written: Path) -> None:
    """Coordinates differ from those of `view_normalize`, cloud by cloud, by at most half a step."""
    dataset = ViewDataset.open(written)
    assert dataset.classes == ("tennis_ball", "screwdriver")
    assert len(dataset) == 60 and [(shard.label, shard.views) for shard in dataset.shards] == [(0, 30), (1, 30)]
    for index, (name, clouds) in enumerate(render_views(OBJECTS, 60, 45).items()):
        views = dataset.read(index)
        assert dataset.classes[views.label] == name
        assert views.view.tolist() == list(range(30)) and not views.copy.any()
        assert views.counts.tolist() == [len(xyz) for xyz, _ in clouds] and len(views) == 30
        for (xyz, rgb), cloud in list(zip(views.clouds(), clouds, strict=True))[::10]:
            normal = thor2_jax.view_normalize(thor2_jax.PointClouds.pack([cloud]), CONFIG)
            assert np.abs(xyz - np.asarray(normal.points)[0, : len(xyz)]).max() <= COORDINATE_STEP / 2 * 1.02
            assert np.array_equal(rgb, cloud[1])
        assert np.array_equal(views.xyz, views_of(clouds).xyz)
        assert np.array_equal(np.rint(views.xyz / COORDINATE_STEP), views.xyz / COORDINATE_STEP)
    assert dataset.digest == hashlib.sha256((written / "manifest.json").read_bytes()).hexdigest()
    record = json.loads(json.dumps(dataset.record))
    assert record["digest"] == dataset.digest and record["views"] == 60 and record["left_out"] == 0
    assert record["job"]["azimuth_step"] == 60 and record["job"]["variations"] is None
    assert [entry["name"] for entry in record["job"]["objects"]] == list(OBJECTS)
    size = sum(path.stat().st_size for path in written.iterdir())
    assert size < 9 * sum(shard.points for shard in dataset.shards) + 60 * 100  # bytes for a point and for a view


def test_empty_views_and_views_beyond_the_range() -> None:
    nothing = views_of([])
    assert len(nothing) == 0 and nothing.xyz.shape == (0, 3) and nothing.clouds() == []
    assert len(encode(nothing)) > 0
    line = np.linspace(0, 1, 50, dtype=np.float32)[:, None] * np.array([0, 0, 1], np.float32)
    rgb = np.zeros((50, 3), np.uint8)
    assert views_of([(line * np.float32(MAX_VIEW_LENGTH / 2.5), rgb)]).xyz.max() == MAX_VIEW_LENGTH
    assert_refused("4.05 scaled units", views_of, [(line, rgb), (line * np.float32(1.62), rgb)])


def test_padded_batches() -> None:
    clouds = random_clouds(0, (3, 2100, 5))
    batches = list(padded_batches(clouds, 2))
    assert [count for count, _ in batches] == [2, 1]
    assert [batch.mask.shape for _, batch in batches] == [(2, 4096), (2, 2048)]
    assert [batch.mask.sum(axis=1).tolist() for _, batch in batches] == [[3, 2100], [5, 0]]
    assert list(padded_batches([], 2)) == []


def check_refused(directory: Path, message: str) -> None:
    assert_refused(f"{directory}.*{message}", lambda: ViewDataset.open(directory).read(1))


def test_incomplete_and_other_datasets_are_refused(copied: Path) -> None:
    """The message has the name of the file and the reason; tests/fuzz/test_tables.py has all kinds of damage."""
    path = copied / "0001-0000.safetensors"
    shutil.copy(copied / "0000-0000.safetensors", path)
    check_refused(copied, "0001-0000.safetensors is missing or damaged")
    path.unlink()
    check_refused(copied, "0001-0000.safetensors is missing or damaged")
    assert len(ViewDataset.open(copied).read(0)) == 30
    manifest, path = ViewDataset.open(copied).manifest, copied / "manifest.json"
    Manifest({**manifest.job, "descriptor_version": 99}, manifest.shards).write(copied)
    check_refused(copied, "descriptor version 99")
    dataclasses.replace(manifest, shards=manifest.shards[:1]).write(copied)
    check_refused(copied, "1 of 2 shards")
    for content in ("[]", "{}", "[" * 100_000, path.read_text().replace('"label": 0', '"label": 1')):
        path.write_text(content)
        check_refused(copied, "manifest.json is damaged")
    path.write_text('{"format": 1, "sigma_s": 2.5, "voxel": 0.01, "objects": {"a": {}}}')
    check_refused(copied, "format 1; expected 2")
    path.unlink()
    check_refused(copied, "manifest.json cannot be read")
    check_refused(copied / "absent", "is not a directory")
