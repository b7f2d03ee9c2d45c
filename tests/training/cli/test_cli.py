"""The command line: every command and invalid input, with a small model of random weights."""

import dataclasses
import json
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
from commands import STEPS, Command, Texts, frame_options, run_thor2
from rendered_objects import write_meshes, write_scene
from written_files import files_of

import colornet
from thor2_jax.errors import InputError
from thor2_jax.files import temporary_directory
from thor2_jax.model.run_directory import load_run, save_run
from thor2_jax.networks.networks import FEATURES
from training.protocol import DEFAULT, PAPER, QUICK
from training.readers.frames import frame_files
from training.train_job import TrainJob

pytestmark = pytest.mark.usefixtures("small_classifiers")

NAMES = ("soup_can_red", "yellow_box", "mug_white")
FEW_STEPS = ("--epochs", 1, "--batch-size", 64, "--classifiers", "tops,tops2", "--embedding", 0)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory of three PLY files with vertex colours."""
    return write_meshes(tmp_path_factory.mktemp("meshes"), NAMES)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the files of a scene, as `recognize` and `evaluate frames` read them."""
    return write_scene(tmp_path_factory.mktemp("frames") / "one", NAMES, 3)


@pytest.fixture(scope="module")
def model(
    meshes: Path, views: Path, small_descriptors: None, without_steps: Any, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return the run directory of a model of three objects with random weights; its views have been rendered before."""
    out = tmp_path_factory.mktemp("model") / "run"
    shutil.copytree(views, out / "views")
    with without_steps():
        assert run_thor2("train", "--meshes", meshes, "--out", out, *STEPS, *FEW_STEPS) == 0
    return out


@pytest.fixture(scope="module")
def views(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a dataset of the views that the default protocol renders, by `render`."""
    out = tmp_path_factory.mktemp("rendered") / "views"
    augmentations = ("--illumination", "--sensor", "--occlusion", "--segmentation", "--registration", "--base")
    assert run_thor2("render", "--meshes", meshes, "--out", out, *STEPS, *augmentations) == 0
    return out


def test_evaluate_frames(model: Path, images: Path, tmp_path: Path, printed: Command, refused: Command) -> None:
    """Two runs are evaluated and agree with `recognize`; a repeated command keeps the answers."""
    other = tmp_path / "other"
    save_run(dataclasses.replace(load_run(model), record={"another": "run"}), other)
    command = ("evaluate", "frames", images.parent, "--model", model, other, "--out", tmp_path / "report")
    out = printed(*command)
    assert "THOR2" in out and "a second" in out
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["worst"][0]["frame"] == images.name
    assert f"thor2 explain {images} --instance {report['worst'][0]['label']} --model {model} " in out
    assert report["dataset"]["path"] == str(images.parent)
    printed("recognize", "--model", model, *frame_options(images), "--out", tmp_path / "answer", "--unknown-below", 0)
    answers = json.loads((tmp_path / "answer" / "recognition.json").read_text())
    truth = frame_files(images).read_names()
    expected = np.mean([a["name"] == truth[a["label"]] for a in answers])
    whole = report["accuracy"][report["rule"]][0]["cells"][0]
    assert report["instances"]["scored"] == whole["instances"] == len(truth)
    assert whole["accuracy"]["THOR2"] == {"mean": pytest.approx(expected), "std": 0.0, "runs": 2}
    kept = (tmp_path / "report" / "answers.jsonl").read_bytes()
    assert "nothing was recomputed" in printed(*command)
    assert (tmp_path / "report" / "answers.jsonl").read_bytes() == kept
    assert "already contains" in refused(*command[:-1], tmp_path / "answer")
    assert "address is head:6379" in refused(*command, "--address", "head:6379")
    assert str(tmp_path / "absent") in refused("evaluate", "uwis", tmp_path / "absent", "--model", model)


def test_labels_without_pixels(model: Path, images: Path, tmp_path: Path, texts: Texts) -> None:
    labels = Path(shutil.copytree(images, tmp_path / "one")) / "labels.json"
    names = json.loads(labels.read_text())["labels"]
    for more in ({}, {"200": "mug_white"}):
        labels.write_text(json.dumps({"labels": names | more}))
        out, err = texts("evaluate", "frames", tmp_path, "--model", model, "--quiet")
        assert err == "" and ("without pixels" in out) == ("200 of frame one" in out) == bool(more)


def test_output_is_checked_before_the_work(meshes: Path, images: Path, tmp_path: Path, refused: Command) -> None:
    """The inputs are read later, and are missing."""
    absent = tmp_path / "absent"
    for out in (Path("/proc/no/directory"), images / "color.png" / "run"):
        for command in (
            ("recognize", "--model", absent, *frame_options(absent)),
            ("train", "--meshes", absent),
            ("train", "--dataset", absent),
            ("render", "--meshes", meshes),
            ("demo",),
        ):
            assert f"out: {out}" in refused(*command, "--out", out), command


@pytest.mark.usefixtures("small_descriptors")
def test_a_default_training_recognizes_and_is_evaluated(
    weights: str, meshes: Path, views: Path, images: Path, tmp_path: Path, texts: Texts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without --classifiers, a run has an embedding alone; the command that is printed recognizes with it."""
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "my run"
    shutil.copytree(views, out / "views")  # of an interrupted training
    command = ("train", "--meshes", meshes, "--out", out, *STEPS, "--epochs", 1, "--embedding", 10)
    text, err = texts(*command)
    assert "embedding has a held-out accuracy of 0." in text.replace("1.000", "0.")
    stages = [line.split(":")[0] for line in err.splitlines() if line.startswith("stage ")]
    assert list(dict.fromkeys(stages)) == [f"stage {number} of 5" for number in (1, 2, 3, 4, 5)]
    assert len(list((tmp_path / "cache").glob("distractors-*"))) == (weights == "fitted")

    (line,) = [line for line in text.splitlines() if "thor2 recognize" in line]
    program, *arguments = shlex.split(line.split(" with: ")[1])
    monkeypatch.chdir(images)
    assert program == "thor2" and str(out) in line
    answers, _ = texts(*arguments, "--unknown-below", 0)
    assert any(name in answers for name in NAMES)
    evaluation = ("evaluate", "frames", images.parent, "--model", out, "--out", tmp_path / "report")
    assert "embedding" in texts(*evaluation)[0]
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert list(report["accuracy"][report["rule"]][0]["cells"][0]["accuracy"]) == ["embedding"]
    text, _ = texts(*command)
    assert "nothing was trained" in text and line.split(" with: ")[1] in text


def test_options_of_protocols(meshes: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs: list[TrainJob] = []
    monkeypatch.setattr("training.protocol.DEFAULT", DEFAULT)
    monkeypatch.setattr("training.protocol.PAPER", PAPER)
    monkeypatch.setattr("training.train_job.run_train_job", lambda job, progress: jobs.append(job) or {})

    def job(*options: object) -> TrainJob:
        assert run_thor2("train", "--meshes", meshes, "--out", tmp_path / "run", *options) == 0
        return jobs[-1]

    replace = dataclasses.replace
    distractors, quick = (replace(each.distractors, workers=2) for each in (DEFAULT, QUICK))
    default = replace(DEFAULT, distractors=distractors)
    assert (distractors.procedural, quick.procedural) == (1500, 600)
    assert job().protocol == default and default.classifiers == ()
    assert job("--quick").protocol == replace(QUICK, distractors=quick)
    changed = job("--quick", "--embedding", 50, "--epochs", 2, "--azimuth-step", 40).protocol
    assert changed.distractors == replace(quick, procedural=50, epochs=2)
    assert (changed.azimuth_step, changed.polar_step, changed.fit.epochs) == (40, QUICK.polar_step, 2)
    others = job("--distractors", meshes, "--mesh-scale", 0.5).protocol.distractors.meshes
    assert others.keys() == set(NAMES) and others["yellow_box"].longest_side == pytest.approx(0.11 / 2)
    assert job("--classifiers", "ce").protocol == replace(default, classifiers=("ce",))
    assert job("--embedding", 0).protocol == replace(DEFAULT, classifiers=FEATURES, distractors=None)
    assert job("--paper").protocol == PAPER and PAPER.classifiers == FEATURES and PAPER.distractors is None
    assert (PAPER.fit.epochs, *PAPER.fit.learning_rates, PAPER.azimuth_step) == (100, 0.01, 0.001, 5)
    assert (PAPER.fit.batch_size, len(PAPER.mirrors), PAPER.augmentations) == (128, 4, None)
    paper = job("--paper", "--embedding", 20, "--epochs", 3).protocol
    assert paper.distractors == replace(distractors, procedural=20, epochs=3) and paper.classifiers == FEATURES
    assert job("--folds", 3).protocol == replace(default, folds=3)
    assert "quick" in refused("train", "--meshes", meshes, "--out", tmp_path / "run", "--quick", "--paper")
    for option in ("--batch-size", "--orientation-copies"):
        assert option in refused("train", "--meshes", meshes, "--out", tmp_path / "run", option, 2)
        assert job(option, 2, "--paper").protocol != PAPER


def test_baselines_of_a_finished_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command) -> None:
    monkeypatch.setattr("training.train_job.run_train_job", lambda job, progress: {job.out: []})
    command = ("train", "--dataset", tmp_path, "--out", tmp_path / "run")
    assert "nothing was trained" in printed(*command)
    assert "nothing was trained" not in printed(*command, "--baselines", "forest")
    for surfaces in (None, object()):
        record = {"dataset": {}, "held_out_accuracy": {}}
        trained = SimpleNamespace(record=record, embedding=object(), surfaces=surfaces, classes=())
        monkeypatch.setattr("training.train_job.run_train_job", lambda job, progress: {job.out: [trained]})  # noqa: B023
        assert ("no surfaces" in printed(*command)) == (surfaces is None)
    enrolled = SimpleNamespace(objects={"mug": SimpleNamespace(clouds=[1, 2])})
    monkeypatch.setattr("thor2_jax.gallery.store.load_gallery", lambda _: enrolled)
    assert "enrolled, too, since they have no mesh: mug (views: 2)" in printed(*command)


@pytest.mark.usefixtures("small_descriptors", "weights")
def test_train_by_folds(
    meshes: Path, views: Path, tmp_path: Path, printed: Command, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mesh of an object that is left out is not read."""
    options = ("--epochs", 1, "--batch-size", 16, "--classifiers", "tops", "--folds", 2, "--embedding", 0)
    (shutil.copytree(meshes, tmp_path / "meshes") / "bad.ply").touch()
    options += ("--meshes", tmp_path / "meshes", "--leave-out", "bad")
    arguments = ("train", "--out", tmp_path / "run", *STEPS, *options)
    shutil.copytree(views, tmp_path / "run" / "views")
    out = printed(*arguments)
    assert "fold 0: tops" in out and "fold 1: tops" in out and "(objects: 3)" in out
    # Views in a finished run directory may be a dataset of the user, and are kept.
    (tmp_path / "run" / "views").mkdir()
    (tmp_path / "run" / "views" / "manifest.json").write_bytes(bytes(9))
    before = files_of(tmp_path / "run")
    with temporary_directory(tmp_path / "run") as temporary:
        shutil.copytree(temporary, tmp_path / "run" / ".thor2-killed")
    assert "nothing was trained" in printed(*arguments)
    own_views = ("--dataset", tmp_path / "run" / "views", "--out", tmp_path / "run", "--embedding", 0)
    assert "manifest.json" in refused("train", *own_views)
    for change in (("--leave-out", f"bad,{NAMES[0]}"), ("--epochs", 2)):
        assert f"was written with {change[0][2:].replace('-', '_')}" in refused(*arguments, *change)
    assert files_of(tmp_path / "run") == before
    # A training that is killed at the very end leaves its own views.
    shutil.rmtree(tmp_path / "run" / "views")
    shutil.copytree(views, tmp_path / "run" / "views")
    assert run_thor2(*arguments) == 0
    assert not [path for path in (tmp_path / "run").iterdir() if path.name[0] == "." or path.name == "views"]

    def render(*_: object, **__: object) -> None:
        raise InputError("views are rendered")

    monkeypatch.setattr("training.train_job.render_dataset", render)
    for fold in ("fold-0", "fold-1"):
        assert "views are rendered" in refused(*arguments, "--baselines", "forest")
        (tmp_path / "run" / fold / "baselines").mkdir()
        (tmp_path / "run" / fold / "baselines" / "forest.safetensors").touch()
    assert "only missing baselines were trained" in printed(*arguments, "--baselines", "forest")


@pytest.mark.usefixtures("unfitted")
def test_train_by_sequences(meshes: Path, views: Path, tmp_path: Path, refused: Command, texts: Texts) -> None:
    """Each run has the objects of its sequence, whose name is shown; a repeated command trains only missing runs."""
    soup, box, mug = NAMES
    table, out = tmp_path / "table.yaml", tmp_path / "runs"
    options = ("--sequences", table, "--epochs", 1, "--batch-size", 16, "--classifiers", "ce", "--embedding", 0)
    arguments = ("train", "--dataset", views, "--out", out, *options)
    table.write_text(json.dumps({"table/a": [soup, mug]}))
    assert "table/a: stage 1 of 2: describe: " in texts(*arguments)[1]
    first = (out / "table/a/run.json").read_bytes()
    assert sorted(json.loads(first)["classes"]) == sorted([soup, mug])
    table.write_text(json.dumps({"table/a": [soup, mug], "b": [box, box, soup]}))
    with temporary_directory(out / "table/a") as temporary:
        shutil.copytree(temporary, out / "table/a" / ".thor2-killed")
    assert run_thor2(*arguments) == 0
    assert not list(out.rglob(".thor2-*"))
    assert (out / "table/a/run.json").read_bytes() == first
    assert sorted(json.loads((out / "b/run.json").read_text())["classes"]) == sorted([soup, box])
    before = sorted(out.rglob("*"))
    table.write_text(json.dumps({"b": [box, soup], "c": [soup, mug]}))
    for change in (("--epochs", 2), ("--batch-size", 8), ("--seed", 1), ("--folds", 2), ("--classifiers", "ce,tops")):
        assert "b was written with" in refused(*arguments, *change)
    assert sorted(out.rglob("*")) == before
    for content, message in (
        (json.dumps({"b": [box, mug]}), "b was written with dataset"),
        ("{}", "has no sequence"),
        ('{"c": ["dragon"]}', "no class dragon"),
        ('{"c": "mug"}', "c is 'mug'"),
        ('{"d": ["yellow_box", "soup_can_red"], "c": ["mug_white"]}', "the objects with views are mug_white"),
        ('{"c": []}', "c is []"),
        ('{"../c": ["mug_white"]}', "'../c'"),
        ('{"/c": ["mug_white"]}', "'/c'"),
    ):
        table.write_text(content)
        assert message in refused(*arguments), content
    assert "--dataset" in refused("train", "--meshes", meshes, "--out", tmp_path / "other", *options)
    assert sorted(p.name for p in out.iterdir()) == ["b", "table"]


@pytest.mark.usefixtures("unfitted")
def test_rendered_views_stay(meshes: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "run"
    command = ("train", "--meshes", meshes, "--out", out, *STEPS)
    assert "folds is 99" in refused(*command, "--folds", 99, at_once=False)
    assert "--batch-size is 100000" in refused(*command, "--batch-size", 100_000, at_once=False)
    assert not out.exists()  # no view was rendered
    with monkeypatch.context() as patch:
        patch.setattr("training.train_job.train_run", mock.Mock(side_effect=InputError("stopped")))
        assert "stopped" in refused(*command, at_once=False)
    assert [p.name for p in out.iterdir()] == ["views"]


def test_colornet(tmp_path: Path, printed: Command, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colornet, "build", colornet.load_default)  # tests/colornet builds it
    out = printed("colornet", "--out", tmp_path / "network")
    assert "23 raw nodes, 22 regions, 55 edges; equal to the packaged network" in " ".join(out.split())
    assert sorted(p.name for p in (tmp_path / "network").iterdir()) == ["network.npz", "network.png", "similarity.png"]
    assert "already contains" in refused("colornet", "--out", tmp_path / "network")
