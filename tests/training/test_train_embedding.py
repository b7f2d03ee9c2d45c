"""Trainings of an embedding alone: files of a run, interruptions, folds, and the user's cache."""

import dataclasses
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
import pytest
from failures import Interrupted, interrupt_at
from refusals import assert_refused
from small_clouds import brick_and_stick
from small_runs import SMALL_CONFIG

from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.run_directory import TrainedRun, load_run
from thor2_jax.recognizer import Recognizer
from thor2_jax.types import Cloud, PointClouds
from training import train_run as module
from training.embedding import distractors
from training.embedding.distractors import Distractors, render_clouds
from training.fitting.fit import fit_calibration
from training.fitting.loop import Checkpoints, FitOptions
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of
from training.protocol import Protocol
from training.train_run import check_trained, read_metrics, train_run
from training.views.normalized_views import MemoryViews

DISTRACTORS = Distractors(procedural=10, views=4, epochs=3, networks=2)
CLOUDS = brick_and_stick(8)
CLASSES = tuple(CLOUDS)
SOURCE = MemoryViews(CLOUDS, SMALL_CONFIG)
SOURCE.surfaces = surfaces_of(list(builtin_objects().values())[: len(CLASSES)])


@pytest.fixture(scope="module", autouse=True)
def cache(small_networks: None, tmp_path_factory: pytest.TempPathFactory, module_patch: pytest.MonkeyPatch) -> Path:
    """A user's cache, in which the first training keeps the samples of the distractors."""
    directory = tmp_path_factory.mktemp("cache")
    module_patch.setenv("THOR2_CACHE", str(directory))
    return directory


SETTINGS = Protocol((), FitOptions(), SMALL_CONFIG, distractors=DISTRACTORS)


def train(out: Path, settings: Protocol = SETTINGS, **more: Any) -> list[TrainedRun]:
    return train_run(SOURCE, out, settings, **more)


Whole = tuple[Path, TrainedRun, list[str], list[tuple[int, Cloud]]]
"""Directory, run, stages and held-out clouds of a training."""


@pytest.fixture(scope="module")
def whole(cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """An uninterrupted training."""
    out, stages = tmp_path_factory.mktemp("whole") / "run", dict[str, int]()
    with mock.patch.object(module, "fit_calibration", wraps=fit_calibration) as calibrate:
        (run,) = train(out, progress=lambda stage, done, total, note: stages.__setitem__(stage, done - total))
    assert set(stages.values()) == {0}
    return out, run, list(stages), calibrate.call_args.args[1]


def rows(out: Path) -> list[dict[str, Any]]:
    return [{**row, "samples_per_second": None} for row in read_metrics(out / "metrics.jsonl")]


def test_a_run_without_classifiers(whole: Whole, cache: Path) -> None:
    out, run, stages, _ = whole
    names = {f"{name}.safetensors" for name in ("embedding", "references", "surfaces")}
    assert {path.name for path in out.iterdir()} >= {*names, "run.json"}
    jax.tree.map(np.testing.assert_array_equal, run.surfaces, SOURCE.surfaces)
    assert stages == [*SETTINGS.stages] and len(stages) == 4
    assert run.classifiers == {} and run.embedding is not None
    assert run.embedding.classes == run.classes == CLASSES and len(run.embedding.further) == 1
    record, logged = run.record, [(row["fold"], row["classifier"], row["epoch"], row["loss"]) for row in rows(out)]
    assert record["classifiers"] == [] and record["distractors"] == DISTRACTORS.record
    assert logged == [(0, "embedding", row["epoch"], row["loss"]) for row in record["curves"]["embedding"]]
    assert [epoch for *_, epoch, _ in logged] == [1, 2, 3] and 0 <= record["held_out_accuracy"]["embedding"] <= 1
    recognizer = Recognizer.load(out)
    assert recognizer.model.chosen_classifiers() == ("embedding",) and recognizer.model.answers_by() == "classifiers"
    assert len(list(cache.glob("distractors-*"))) == 1


def test_the_confidence_is_fitted_on_held_out_clouds(whole: Whole) -> None:
    """They are those of the views and of each tenth distractor, in metres."""
    _, run, _, views = whole
    calibration, _ = fit_calibration(run, views)
    assert run.record.get("calibration") == (None if calibration is None else dataclasses.asdict(calibration))
    assert run.embedding is not None and run.embedding.distractors == 9 and run.embedding.sizes.nearest
    assert sorted(label for label, _ in views) == [0, 1, 2, 2, 2, 2]
    expected = render_clouds({0: DISTRACTORS.sources[0]}, 4)
    for (label, (xyz, rgb)), (_, (points, colors)) in zip(views[2:], expected, strict=True):
        assert label == 2 and np.array_equal(xyz, points) and np.array_equal(rgb, colors)
    for name, (label, cloud) in zip(CLASSES, views, strict=False):  # normalized before, but described as they were
        clouds = PointClouds.pack([*CLOUDS[name], cloud])
        images = np.asarray(describe_looks(clouds, run.network, SMALL_CONFIG, 4).each.images)
        before, looks = images[:-1], images[-1:]
        assert label == CLASSES.index(name)
        assert np.abs(before - looks).max(axis=(1, 2, 3, 4)).min() < 0.03 * looks.max()  # of another view: above 0.25


def test_an_interrupted_joint_fit_resumes(whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a cache, the samples of the distractors are those in the run's own directory."""
    monkeypatch.setenv("THOR2_CACHE", "off")
    out = tmp_path / "run"
    sample = mock.Mock(wraps=distractors.sample_normalized)
    monkeypatch.setattr(distractors, "sample_normalized", sample)
    for stage, step in (("render distractors", 10), ("describe for the embedding", 8), ("fit networks", 2)):
        interrupt_at(stage, step, train, out)
        assert_refused(r"run\.json", load_run, out)
    with monkeypatch.context() as patch, pytest.raises(Interrupted):  # an epoch is logged and has no checkpoint yet
        patch.setattr(Checkpoints, "save", mock.Mock(side_effect=Interrupted))
        train(out)
    (run,) = train(out)
    assert sample.call_count == 1
    assert (out / "embedding.safetensors").read_bytes() == (whole[0] / "embedding.safetensors").read_bytes()
    assert run.record == whole[1].record and rows(out) == rows(whole[0])
    assert not (out / "checkpoints").exists()


def test_invalid_and_changed_distractors_are_refused(whole: Whole) -> None:
    check_trained(SOURCE.digest, whole[0], SETTINGS)
    for other in ({"networks": 3}, {"epochs": 4}, {"procedural": 11}):
        settings = dataclasses.replace(SETTINGS, distractors=dataclasses.replace(DISTRACTORS, **other))
        assert_refused(next(iter(other)), check_trained, SOURCE.digest, whole[0], settings)
    assert_refused("there are 9 objects", dataclasses.replace, DISTRACTORS, procedural=9)


def test_folds_share_distractors_and_enroll_given_views(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THOR2_CACHE", "off")
    sample = mock.Mock(wraps=distractors.sample_normalized)
    monkeypatch.setattr(distractors, "sample_normalized", sample)
    stages: dict[str, None] = {}
    views = [PreparedInstance(1, xyz, rgb, np.zeros(len(xyz), bool)) for xyz, rgb in CLOUDS[CLASSES[1]]]
    short = dataclasses.replace(SETTINGS, distractors=dataclasses.replace(DISTRACTORS, epochs=1), folds=2)
    seen, enrolled = (lambda stage, *values: stages.setdefault(stage)), {CLASSES[1]: views}
    runs = train(tmp_path / "run", short, progress=seen, enrolled=enrolled)
    assert list(stages) == list(short.stages)
    assert [run.record["fold"] for run in runs] == [0, 1]
    assert all(list(run.record["held_out_accuracy"]) == ["embedding"] for run in runs)
    assert [(row["fold"], row["classifier"]) for row in rows(tmp_path / "run")] == [(0, "embedding"), (1, "embedding")]
    assert sample.call_count == 1
    for fold in range(2):
        recognizer = Recognizer.load(tmp_path / f"run/fold-{fold}")
        assert recognizer.model.answers_by() == "both" and recognizer.classes == CLASSES
        assert {name: len(each.clouds) for name, each in recognizer.gallery.objects.items()} == {CLASSES[1]: 8}
