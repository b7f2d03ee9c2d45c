"""Trainings: uninterrupted, interrupted and resumed, with several folds, and two in the same run directory."""

import dataclasses
import functools
import os
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from failures import Interrupted, full_disk, interrupt_at
from PIL import Image
from refusals import assert_refused
from small_clouds import brick_and_stick, random_clouds
from written_files import files_of, files_of_the_user

import thor2_jax as thor2
from thor2_jax.model.run_directory import TrainedRun, load_run
from thor2_jax.networks.networks import model_arrays
from training import train_run as module
from training.evaluation.runs import load_runs
from training.fitting.fit import FitContext, fit_temperature, sample_probabilities
from training.fitting.loop import Checkpoints, FitOptions
from training.fitting.samples import sample_views
from training.protocol import Protocol
from training.storage.jobs import begin_job
from training.train_run import train_run
from training.views.normalized_views import MemoryViews, fold_of_views

pytestmark = pytest.mark.usefixtures("small_classifiers")

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=3, n_strips=8, image_size=8)
OPTIONS = FitOptions(epochs=3, batch_size=8)
FINISHED = ["curves.png", "metrics.jsonl", "network.npz", "run.json", "weights"]


def source(seed: int = 0) -> MemoryViews:
    return MemoryViews(brick_and_stick(6, seed), CONFIG)


def train(out: Path, features: tuple[str, ...] = ("tops",), options: FitOptions = OPTIONS, **more: Any) -> TrainedRun:
    (run,) = train_run(source(), out, Protocol(features, options, CONFIG), **more)
    return run


def same_weights(*runs: TrainedRun) -> None:
    np.testing.assert_equal(*({name: model_arrays(model) for name, model in run.classifiers.items()} for run in runs))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def logged_rows(path: Path) -> list[tuple[Any, ...]]:
    rows = module.read_metrics(path / "metrics.jsonl")
    return [(row["fold"], row["classifier"], row["epoch"], row["loss"], row["accuracy"]) for row in rows]


@pytest.fixture(scope="module", autouse=True)
def every_step_is_reported(module_patch: pytest.MonkeyPatch) -> None:
    """Report each step, so that a training can be interrupted at any of them."""
    module_patch.setattr("training.fitting.loop.STEPS_PER_REPORT", 1)


@pytest.mark.usefixtures("drawn_pictures")
def test_a_run_is_written_and_its_progress_is_reported(tmp_path: Path) -> None:
    stages: list[tuple[str, int, int]] = []

    def progress(stage: str, done: int, total: int, note: str) -> None:
        stages.append((stage, done, total))
        if stage != "describe":
            assert "loss" in note and "accuracy" in note
            assert ("samples/s" in note) == (done % 3 != 1)  # the first step of an epoch is not timed

    run, record = train(tmp_path / "run", progress=progress), load_run(tmp_path / "run").record
    assert run.classes == ("red brick", "stick") and tuple(run.classifiers) == ("tops",) and record == run.record
    fit_steps = [("fit tops", done, 9) for done in range(1, 10)]
    assert stages == [("describe", 6, 12), ("describe", 12, 12), *fit_steps]
    assert (record["samples"], record["batch_size"], record["folds"], record["held_out_accuracy"]) == (24, 8, 1, {})
    assert record["dataset"] == source().record and record["dataset"]["views"] == 12
    curve = record["curves"]["tops"]
    assert [row["epoch"] for row in curve] == [1, 2, 3] and curve[-1]["accuracy"] > 0.9  # of all steps of an epoch
    assert record["kept_epochs"] == {"tops": min(curve, key=lambda row: row["loss"])["epoch"]}
    assert [(0, "tops", *row.values()) for row in curve] == logged_rows(tmp_path / "run")
    with Image.open(tmp_path / "run" / "curves.png") as picture:
        assert picture.width > 300


def test_invalid_input_is_refused_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "sample_views", lambda *_, **__: pytest.fail("the training started"))
    assert_refused(r"classifiers is \('shape',\)", train, tmp_path / "new", ("shape",))
    monkeypatch.setattr("jax.device_count", lambda: 3)
    assert_refused("batch_size is 8; .*multiple of the 3 devices", train, tmp_path / "new")
    assert not list(tmp_path.iterdir())


STICK = brick_and_stick(1)["stick"]


def test_nothing_is_written_for_bad_views(tmp_path: Path) -> None:
    for bad, folds, message in (
        ({}, 1, "the objects with views are none"),
        ({"mug": [], "box": STICK}, 1, "class 'mug' has no views"),
        (brick_and_stick(3), 4, "folds is 4.*'red brick'"),
        ({"a": random_clouds(0, [9000], (9, 9, 9)), "b": STICK}, 1, "9000 points"),
    ):
        settings = Protocol(["tops"], OPTIONS, CONFIG, folds)
        assert_refused(message, train_run, MemoryViews(bad, CONFIG), tmp_path / "run", settings)
        assert names(tmp_path) == []


def test_an_interrupted_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is interrupted first where an epoch is logged and has no checkpoint yet."""
    whole, out = train(tmp_path / "whole", ("tops", "ce")), tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(Interrupted):
        patch.setattr(Checkpoints, "save", mock.Mock(side_effect=Interrupted))
        train(out, ("tops", "ce"))
    assert len(logged_rows(out)) == 1
    for stage, step in (("fit ce", 2), ("fit ce", 8), ("fit tops", 9)):
        interrupt_at(stage, step, train, out, ("tops", "ce"))
        assert_refused(r"run\.json", load_run, out)
    run = train(out, ("tops", "ce"))
    same_weights(run, whole)
    assert run.record == whole.record
    assert logged_rows(out) == logged_rows(tmp_path / "whole")
    assert names(out) == FINISHED


@pytest.mark.usefixtures("unfitted")
def test_failures_before_and_while_the_run_is_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full at several steps; interrupts before the first file is moved to its name, and after some are."""
    out, rename = tmp_path / "run", Path.rename
    for name in ("begin_job", "log_metrics", "draw_curves", "save_run"):
        with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
            patch.setattr(module, name, full_disk)
            train(out)
        assert not (out / "run.json").exists()
    for moved in (None, "tops.safetensors", "network.npz", "run.json"):

        def stopping(self: Path, target: Path) -> Path:
            if target.suffix == ".safetensors" and moved is None:  # noqa: B023
                raise Interrupted
            renamed = rename(self, target)
            if self.name == moved and target.parent in (out, out / "weights"):  # noqa: B023
                raise Interrupted
            return renamed

        with monkeypatch.context() as patch:
            patch.setattr(Path, "rename", stopping)
            with pytest.raises(Interrupted):
                train(out)
        assert (out / "run.json").exists() == (moved == "run.json")
    same_weights(train(out), train(tmp_path / "whole"))
    assert names(out) == FINISHED


def test_other_options_or_views_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "run"
    interrupt_at("fit tops", 4, train, out)
    before = files_of(out)
    begun = Protocol(("tops",), OPTIONS, CONFIG)
    for message, seed, changes in (
        ("epochs 3, not 4", 0, {"fit": dataclasses.replace(OPTIONS, epochs=4)}),
        ("folds 1, not 3", 0, {"folds": 3}),
        (f'dataset "{source().digest}", not ', 1, {}),
        (r"descriptor_config\.\w+ ", 0, {"config": thor2.DescriptorConfig()}),
    ):
        settings = dataclasses.replace(begun, **changes)
        assert_refused(f"out: {out} was written with {message}", train_run, source(seed), out, settings)
    assert files_of(out) == before
    (out / "checkpoints" / "begun.json").write_text("{")
    assert_refused(r"begun\.json cannot be read", train, out)


def test_a_process_with_other_options_than_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = Protocol(["tops"], dataclasses.replace(OPTIONS, epochs=4), CONFIG).record(source().digest)
    begin = functools.partial(begin_job, tmp_path, job, module.JOB)
    monkeypatch.setattr(module, "wait_for_all", lambda point: point == "begun" and begin())
    monkeypatch.setattr("jax.process_index", lambda: 1)
    assert_refused("epochs 4, not 3", train, tmp_path)


def test_files_of_the_user_stay_in_a_run_directory(tmp_path: Path) -> None:
    out = tmp_path / "run"
    (out / "checkpoints").mkdir(parents=True)
    (out / "checkpoints" / "epoch1.pt").write_text("a user's")
    assert_refused(r"already contains epoch1\.pt", train, out)
    (out / "checkpoints" / "epoch1.pt").rename(tmp_path / "epoch1.pt")
    interrupt_at("fit tops", 4, train, out)
    files = ("checkpoints/notes.txt", "weights/pretrained.npz", ".checkpoints/a", ".curves.12345678.png")
    with files_of_the_user(*(out / name for name in files)):
        train(out)
    assert module.is_finished(out)
    assert names(out / "checkpoints") == ["notes.txt"] and load_run(out).classes == ("red brick", "stick")


def test_the_held_out_accuracy_is_that_of_the_kept_epoch() -> None:
    rows = [{"classifier": "tops", **dict.fromkeys(module.CURVE, 0.5), "epoch": epoch} for epoch in (1, 2)]
    rows[1]["held_out_accuracy"] = 0.25
    outcome = module._outcome(rows, {"tops": 1})
    assert outcome["held_out_accuracy"] == {"tops": 0.5} and outcome["kept_epochs"] == {"tops": 1}


def test_folds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted in the second fold, and while the checkpoints are removed after the last one is finished."""
    out, rmdir = tmp_path / "run", os.rmdir

    def run(progress: Any = lambda *_: None) -> None:
        train_run(source(), out, Protocol(["tops"], OPTIONS, CONFIG, 3), progress)

    def stopping(path: Any, **options: Any) -> None:
        if Path(path).name.endswith("checkpoints"):
            raise Interrupted
        rmdir(path, **options)

    interrupt_at("fold 1: fit tops", 4, run)
    first = load_run(out / "fold-0")
    assert module.is_finished(out / "fold-0") and not module.is_finished(out)
    assert names(out) == ["checkpoints", "curves.png", "fold-0", "metrics.jsonl"]
    monkeypatch.setattr(os, "rmdir", stopping)
    with pytest.raises(Interrupted):
        run()
    assert module.is_finished(out)
    runs = [load_run(folder) for folder in module.find_run_directories([out])]
    finished = {"curves.png", "metrics.jsonl", "fold-0", "fold-1", "fold-2"}
    assert {name for name in names(out) if name[0] != "."} == finished
    assert names(out / "fold-2") == ["network.npz", "run.json", "weights"]
    same_weights(runs[0], first)
    samples, _ = sample_views(source(), runs[0].network, CONFIG)
    fold_of = fold_of_views(samples.label, samples.view, source().classes, 3, OPTIONS.seed)
    for fold, one in enumerate(load_runs([out])):
        rows, context = np.flatnonzero(fold_of == fold), FitContext("tops", runs[fold].network, CONFIG)
        probabilities = sample_probabilities(runs[fold].classifiers["tops"], samples, rows, context)
        assert one.temperatures == {"tops": pytest.approx(fit_temperature(probabilities, samples.label[rows]))}
        record = runs[fold].record
        curve = record["curves"]["tops"]
        best = max(row["held_out_accuracy"] for row in curve)
        assert record["fold"] == fold and record["held_out_accuracy"] == {"tops": best}
        assert curve[record["kept_epochs"]["tops"] - 1]["held_out_accuracy"] == best
    with pytest.raises(AssertionError):
        same_weights(runs[0], runs[1])
    assert_refused("out: .* already contains", run)


def test_a_second_training_is_refused(tmp_path: Path) -> None:
    """At every stage of the first training, a second one is refused and changes nothing."""
    out, refusals = tmp_path / "run", []

    def meanwhile(stage: str, done: int, total: int, note: str) -> None:
        if stage == "describe" or done not in (1, total):
            return
        before = files_of(out)
        assert_refused(str(out), train, out)
        refusals.append(stage)
        assert files_of(out) == before

    train(out, progress=meanwhile)
    assert refusals and load_run(out).classes == ("red brick", "stick")
    assert not list(out.rglob(".lock"))


@pytest.mark.slow
def test_a_training_that_another_one_overtakes(tmp_path: Path) -> None:
    """Both start with a new directory, and the slower one is refused or resumes the other one."""
    out, done = tmp_path / "run", []

    def quicker(stage: str, count: int, total: int, note: str) -> None:
        if stage == "describe" and not done:
            done.append(train(out))

    assert_refused("already contains", train, out, progress=quicker)
    assert load_run(out).record == done[0].record

    other = tmp_path / "other"

    def dies(stage: str, count: int, total: int, note: str) -> None:
        if stage == "describe" and not other.exists():
            interrupt_at("fit tops", 3, train, other)

    assert train(other, progress=dies).record == done[0].record  # resumes the other training
