"""The command line: every command and invalid input, with a small model of random weights."""

import dataclasses
import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, files_of, frame_options, run_thor2, write_frame_files, write_meshes
from PIL import Image

import colornet
from thor2_jax.files import temporary_directory
from thor2_jax.gallery.embedding import Embedding, load_default
from thor2_jax.model.classifier import FEATURES
from thor2_jax.model.run_directory import load_run, save_run
from thor2_jax.recognizer import Recognizer
from training import train_job
from training.fitting import protocol
from training.fitting.protocol import DEFAULT, PAPER, QUICK
from training.objects.builtin_objects import builtin_objects
from training.rendering.scenes import Scene, compose_scene
from training.train_job import TrainJob

pytestmark = pytest.mark.usefixtures("small_classifiers")

UNFITTED = pytest.mark.usefixtures("unfitted")
NAMES = ("soup_can_red", "cereal_box_blue", "mug_white")
STEPS = ("--azimuth-step", 180, "--polar-step", 90, "--workers", 1)
FEW_STEPS = ("--epochs", 1, "--batch-size", 64, "--classifiers", "tops,tops2", "--embedding", 0)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory of three PLY files with vertex colours."""
    return write_meshes(tmp_path_factory.mktemp("meshes"), NAMES)


@pytest.fixture(scope="module")
def scene() -> Scene:
    objects = builtin_objects()
    return compose_scene({name: objects[name] for name in NAMES}, np.random.default_rng(3), n_objects=3)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    """Return a directory with the files of the scene, as `recognize` and `evaluate frames` read them."""
    return write_frame_files(tmp_path_factory.mktemp("frames") / "one", scene.frame, scene.truth)


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


def test_files_of_a_run_directory(model: Path) -> None:
    files = ["curves.png", "metrics.jsonl", "network.npz", "run.json", "weights"]
    assert sorted(p.name for p in model.iterdir()) == files
    assert len((model / "metrics.jsonl").read_text().splitlines()) == 2
    description = json.loads((model / "run.json").read_text())
    assert sorted(description["classes"]) == sorted(NAMES)
    assert description["descriptor_version"] == 1


def test_evaluate_frames(
    model: Path, images: Path, scene: Scene, tmp_path: Path, printed: Command, refused: Command
) -> None:
    """Two runs are evaluated and agree with `recognize`; a repeated command keeps the answers."""
    other = tmp_path / "other"
    save_run(dataclasses.replace(load_run(model), record={"another": "run"}), other)
    command = ("evaluate", "frames", images.parent, "--model", model, other, "--out", tmp_path / "report")
    out = printed(*command)
    assert "THOR2" in out and "a second" in out
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    printed("recognize", "--model", model, *frame_options(images), "--out", tmp_path / "answer", "--unknown-below", 0)
    answers = json.loads((tmp_path / "answer" / "recognition.json").read_text())
    expected = np.mean([a["name"] == scene.truth[a["label"]] for a in answers])
    whole = report["accuracy"][report["rule"]][0]["cells"][0]
    assert report["instances"]["scored"] == whole["instances"] == len(scene.truth)
    assert whole["accuracy"]["THOR2"] == {"mean": pytest.approx(expected), "std": 0.0, "runs": 2}
    before = (tmp_path / "report" / "answers.jsonl").read_bytes()
    assert "nothing was recomputed" in printed(*command)
    assert (tmp_path / "report" / "answers.jsonl").read_bytes() == before
    alone = ("evaluate", "frames", images.parent, "--model", model, "--out")
    assert "runs" in refused(*alone, tmp_path / "report")
    assert "already contains" in refused(*alone, tmp_path / "answer")


def test_evaluate_refuses_changed_labels(
    model: Path, images: Path, tmp_path: Path, printed: Command, refused: Command, capfd: pytest.CaptureFixture[str]
) -> None:
    frames = tmp_path / "frames"
    shutil.copytree(images, frames / "one")
    command = ("evaluate", "frames", frames, "--model", model, "--out", tmp_path / "report", "--quiet")
    assert run_thor2(*command) == 0
    out, err = capfd.readouterr()
    assert err == "" and "without pixels" not in out
    labels = frames / "one" / "labels.json"
    names = json.loads(labels.read_text())["labels"]
    labels.write_text(json.dumps({"labels": dict(zip(names, reversed(names.values()), strict=True))}))
    assert "labels.json" in refused(*command)
    labels.write_text(json.dumps({"labels": names | {"200": "mug_white"}}))
    assert "200 of frame one" in printed(*command[:-2], tmp_path / "other")


@pytest.mark.usefixtures("drawn_pictures")
def test_any_name_of_an_object(model: Path, images: Path, scene: Scene, tmp_path: Path, printed: Command) -> None:
    """Names may look like markup, mathtext or terminal commands, and have any characters."""
    names = ("$\\frac{", "[red]mug[/x]", "茶碗\u202e\x1b[2J")
    shown = dict(zip(NAMES, (*names[:2], r"茶碗\u202e\x1b[2J"), strict=True))
    renamed, trained = dict(zip(NAMES, names, strict=True)), load_run(model)
    save_run(dataclasses.replace(trained, classes=tuple(renamed[name] for name in trained.classes)), tmp_path / "run")
    shutil.copytree(images, tmp_path / "frames" / "one")
    truth = {label: renamed[name] for label, name in scene.truth.items()}
    (tmp_path / "frames" / "one" / "labels.json").write_text(json.dumps({"labels": truth}))
    expected = printed("recognize", "--model", model, *frame_options(images))
    out = printed("recognize", "--model", tmp_path / "run", *frame_options(images), "--out", tmp_path / "answer")
    assert all((name in expected) == (shown[name] in out) for name in NAMES)
    assert "\x1b" not in out and "\u202e" not in out
    printed("evaluate", "frames", tmp_path / "frames", "--model", tmp_path / "run", "--out", tmp_path / "report")
    assert (tmp_path / "report" / "confusion.png").is_file()


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


def test_options_without_effect_are_refused(meshes: Path, tmp_path: Path, refused: Command) -> None:
    dataset, out = ("--dataset", tmp_path / "views"), tmp_path / "run"
    cases: tuple[tuple[str, tuple[object, ...]], ...] = (
        ("names", (*dataset, "--names", tmp_path / "names.json")),
        ("azimuth-step", (*dataset, "--azimuth-step", 20)),
        ("polar-step", (*dataset, "--polar-step", 20)),
        ("mesh-scale", (*dataset, "--mesh-scale", 0.001)),
        ("mesh_scale", ("--meshes", meshes, "--mesh-scale", 0)),
        ("processes", (*dataset, "--processes", 2)),
        ("process", (*dataset, "--process", 1)),
        ("distractors", (*dataset, "--embedding", 9)),
        ("distractors", ("--meshes", meshes, "--distractors", meshes)),
        ("process", (*dataset, "--coordinator", "localhost:1", "--processes", 2, "--process", 2)),
        ("azimuth_step", ("--meshes", meshes, "--azimuth-step", 1e-9)),
    )
    for option, arguments in cases:
        assert option in refused("train", *arguments, "--out", out), option
        assert not out.exists()
    assert "azimuth_step" in refused("render", "--meshes", meshes, "--azimuth-step", 1e-9, "--out", out)
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("small_descriptors")
def test_train_on_rendered_dataset_equals_train_on_meshes(meshes: Path, views: Path, tmp_path: Path) -> None:
    """Views written by `render` and read back train the same model as views rendered by `train`."""
    for name, options in {"first": ("--meshes", meshes, *STEPS), "second": ("--dataset", views)}.items():
        assert run_thor2("train", *options, "--out", tmp_path / name, *FEW_STEPS) == 0
    first, second = (json.loads((tmp_path / name / "run.json").read_text()) for name in ("first", "second"))
    assert first["record"]["curves"] == second["record"]["curves"]


@pytest.mark.usefixtures("small_descriptors")
def test_a_default_training_recognizes_and_is_evaluated(
    weights: str,
    meshes: Path,
    views: Path,
    images: Path,
    tmp_path: Path,
    printed: Command,
    refused: Command,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without --classifiers, a run has an embedding alone; the command that is printed recognizes with it."""
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "my run"
    shutil.copytree(views, out / "views")  # of an interrupted training
    command = ("train", "--meshes", meshes, "--out", out, *STEPS, "--epochs", 1, "--embedding", 10)
    assert run_thor2(*command) == 0
    text, err = capfd.readouterr()
    assert "embedding has a held-out accuracy of 0." in text.replace("1.000", "0.")
    stages = [line.split(":")[0] for line in err.splitlines() if line.startswith("stage ")]
    assert list(dict.fromkeys(stages)) == [f"stage {number} of 5" for number in (1, 2, 3, 4, 5)]
    assert load_run(out).record["classifiers"] == [] and list(load_run(out).record["curves"]) == ["embedding"]
    assert Recognizer.load(out).model.classifiers.default == ("embedding",)
    assert len(list((tmp_path / "cache").glob("distractors-*"))) == (weights == "fitted")

    (line,) = [line for line in text.splitlines() if "thor2 recognize" in line]
    program, *arguments = shlex.split(line.split(" with: ")[1])
    monkeypatch.chdir(images)
    assert program == "thor2" and str(out) in line
    answers = printed(*arguments, "--unknown-below", 0)
    assert any(name in answers for name in NAMES)
    evaluation = ("evaluate", "frames", images.parent, "--model", out, "--out", tmp_path / "report")
    assert "embedding" in printed(*evaluation)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert list(report["accuracy"][report["rule"]][0]["cells"][0]["accuracy"]) == ["embedding"]
    text = printed(*command)
    assert "nothing was trained" in text and line.split(" with: ")[1] in text
    assert "classifiers" in refused(*command, "--classifiers", "ce")


def test_options_replace_values_of_the_protocols(
    meshes: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs: list[TrainJob] = []
    monkeypatch.setattr(protocol, "DEFAULT", DEFAULT)
    monkeypatch.setattr(protocol, "PAPER", PAPER)
    monkeypatch.setattr(train_job, "run_train_job", lambda job, display: jobs.append(job) or {})

    def job(*options: object) -> TrainJob:
        assert run_thor2("train", "--meshes", meshes, "--out", tmp_path / "run", *options) == 0
        return jobs[-1]

    replace = dataclasses.replace
    distractors, quick = (replace(each.distractors, workers=2) for each in (DEFAULT, QUICK))
    default = replace(DEFAULT, distractors=distractors)
    assert job().protocol == default and default.classifiers == ()
    assert job("--quick").protocol == replace(QUICK, distractors=quick)
    changed = job("--quick", "--embedding", 50, "--epochs", 2, "--azimuth-step", 40).protocol
    assert changed.distractors == replace(quick, procedural=50, epochs=2)
    assert (changed.azimuth_step, changed.polar_step) == (40, QUICK.polar_step)
    assert job("--classifiers", "ce").protocol == replace(default, classifiers=("ce",))
    assert job("--embedding", 0).protocol == replace(DEFAULT, classifiers=FEATURES, distractors=None)
    assert job("--paper").protocol == PAPER and PAPER.classifiers == FEATURES and PAPER.distractors is None
    paper = job("--paper", "--embedding", 20, "--epochs", 3).protocol
    assert paper.distractors == replace(distractors, procedural=20, epochs=3) and paper.classifiers == FEATURES
    assert job("--folds", 3).protocol == replace(default, folds=3)
    assert "quick" in refused("train", "--meshes", meshes, "--out", tmp_path / "run", "--quick", "--paper")


def test_help_states_the_values_of_the_protocols(printed: Command) -> None:
    text = " ".join(printed("train", "--help").replace("│", " ").split())
    assert "{" not in text
    for name in ("azimuth_step", "polar_step"):
        values = (f"{getattr(protocol, name):g}" for protocol in (DEFAULT, PAPER))
        assert "({}; paper: {})".format(*values) in text
    assert f"({DEFAULT.distractors.procedural}; quick: {QUICK.distractors.procedural}; paper: 0)" in text
    assert f"({DEFAULT.distractors.epochs})" in text


@pytest.mark.slow
def test_train_with_distractors(meshes: Path, images: Path, tmp_path: Path, refused: Command) -> None:
    steps = ("--azimuth-step", 60, "--polar-step", 45, "--workers", 1, "--epochs", 4, "--classifiers", "tops,tops2")
    out = tmp_path / "run"
    command = ("train", "--meshes", meshes, "--out", out, *steps, "--embedding", 30)
    assert run_thor2(*command) == 0
    content = (out / "embedding.safetensors").read_bytes()
    embedding, recognizer = Embedding.load(out / "embedding.safetensors"), Recognizer.load(out)
    assert embedding.classes == recognizer.run.classes and embedding.distractors == 27
    assert recognizer.objects.embedding.fingerprint == embedding.fingerprint != load_default().fingerprint
    assert recognizer.model.classifiers.default == ("tops", "tops2", "embedding")
    record = recognizer.run.record
    assert record["distractors"]["networks"] == protocol.DEFAULT.distractors.networks == 1 + len(embedding.further)
    assert record["distractors"]["epochs"] == record["epochs"] == 4
    assert record["distractors"]["procedural"] == 30 and record["orientation_copies"] == 1
    own = record["calibration"]["unknown_below"]
    assert set(recognizer.model.thresholds()) == {own} and 0 < own < 1
    assert set(Recognizer.load(out, 0.25).thresholds()) == {0.25}
    assert run_thor2("recognize", "--model", out, *frame_options(images), "--out", tmp_path / "answer") == 0
    answers = json.loads((tmp_path / "answer" / "recognition.json").read_text())
    assert {"tops", "tops2", "embedding"} == set(answers[0]["top"])
    assert run_thor2(*command) == 0 and (out / "embedding.safetensors").read_bytes() == content
    assert "orientation_copies" in refused(*command, "--orientation-copies", 2)


@pytest.mark.usefixtures("small_descriptors", "weights")
def test_train_by_folds(meshes: Path, views: Path, tmp_path: Path, printed: Command, refused: Command) -> None:
    options = ("--epochs", 1, "--batch-size", 16, "--classifiers", "tops", "--folds", 2, "--embedding", 0)
    arguments = ("train", "--meshes", meshes, "--out", tmp_path / "run", *STEPS, *options)
    shutil.copytree(views, tmp_path / "run" / "views")
    out = printed(*arguments)
    assert "fold 0: tops" in out and "fold 1: tops" in out
    assert sorted(p.name for p in (tmp_path / "run" / "fold-1").iterdir()) == ["network.npz", "run.json", "weights"]
    # Views in a finished run directory may be a dataset of the user, and are kept.
    (tmp_path / "run" / "views").mkdir()
    (tmp_path / "run" / "views" / "manifest.json").write_bytes(bytes(9))
    before = files_of(tmp_path / "run")
    with temporary_directory(tmp_path / "run") as temporary:
        shutil.copytree(temporary, tmp_path / "run" / ".thor2-killed")
    assert "nothing was trained" in printed(*arguments)
    own_views = ("--dataset", tmp_path / "run" / "views", "--out", tmp_path / "run", "--embedding", 0)
    assert "manifest.json" in refused("train", *own_views)
    for change in (("--epochs", 2), ("--seed", 1), ("--polar-step", 45), ("--leave-out", NAMES[0])):
        assert "was written with" in refused(*arguments, *change)
    assert files_of(tmp_path / "run") == before
    # A training that is killed at the very end leaves its own views.
    shutil.rmtree(tmp_path / "run" / "views")
    shutil.copytree(views, tmp_path / "run" / "views")
    assert run_thor2(*arguments) == 0
    assert not [path for path in (tmp_path / "run").iterdir() if path.name[0] == "." or path.name == "views"]


@UNFITTED
def test_train_by_sequences(meshes: Path, views: Path, tmp_path: Path, refused: Command) -> None:
    """Each run has the objects of its sequence; a repeated command trains only missing runs."""
    soup, cereal, mug = NAMES
    table, out = tmp_path / "table.yaml", tmp_path / "runs"
    options = ("--sequences", table, "--epochs", 1, "--batch-size", 16, "--classifiers", "ce", "--embedding", 0)
    arguments = ("train", "--dataset", views, "--out", out, *options)
    table.write_text(json.dumps({"table/a": [soup, mug]}))
    assert run_thor2(*arguments) == 0
    first = (out / "table/a/run.json").read_bytes()
    assert sorted(json.loads(first)["classes"]) == sorted([soup, mug])
    table.write_text(json.dumps({"table/a": [soup, mug], "b": [cereal, cereal, soup]}))
    assert run_thor2(*arguments) == 0
    assert (out / "table/a/run.json").read_bytes() == first
    assert sorted(json.loads((out / "b/run.json").read_text())["classes"]) == sorted([soup, cereal])
    before = sorted(out.rglob("*"))
    table.write_text(json.dumps({"b": [cereal, soup], "c": [soup, mug]}))
    for change in (("--epochs", 2), ("--batch-size", 8), ("--seed", 1), ("--folds", 2), ("--classifiers", "ce,tops")):
        assert "b was written with" in refused(*arguments, *change)
    assert sorted(out.rglob("*")) == before
    cases = {
        json.dumps({"b": [cereal, mug]}): "b was written with dataset",
        "{}": "has no sequence",
        '{"c": ["dragon"]}': "no class dragon",
        '{"c": "mug"}': "c is 'mug'",
        '{"c": []}': "c is []",
        '{"../c": ["mug_white"]}': "'../c'",
        '{"/c": ["mug_white"]}': "'/c'",
        "[]": "list",
    }
    for content, message in cases.items():
        table.write_text(content)
        assert message in refused(*arguments), content
    assert "--dataset" in refused("train", "--meshes", meshes, "--out", tmp_path / "other", *options)
    assert sorted(p.name for p in out.iterdir()) == ["b", "table"]


def test_one_invalid_instance_leaves_the_others_recognized(
    model: Path, images: Path, scene: Scene, tmp_path: Path, printed: Command
) -> None:
    labels = scene.frame.labels.astype(np.uint8)
    labels[0, :5] = 9
    Image.fromarray(labels).save(tmp_path / "labels.png")
    changed = frame_options(images, labels=tmp_path / "labels.png")
    known = ("--unknown-below", 0)
    assert "unrecognized" in printed("recognize", "--model", model, *changed, "--out", tmp_path / "answer", *known)
    answers = {a["label"]: a for a in json.loads((tmp_path / "answer" / "recognition.json").read_text())}
    assert answers[9]["name"] is None and "30" in answers[9]["reason"]
    assert all(answers[label]["name"] is not None for label in scene.frame.instances)


def test_invalid_images_and_models_are_refused(model: Path, images: Path, tmp_path: Path, refused: Command) -> None:
    """One case of each argument; the tests of `read_frame` and of `load_run` have the others."""
    (tmp_path / "cut.png").write_bytes((images / "depth.png").read_bytes()[:2000])
    (tmp_path / "word.json").write_text('{"fx": 1, "fy": 1, "cx": "left", "cy": 1}')
    with Image.open(images / "mask.png") as mask:
        mask.crop((0, 0, 100, 100)).save(tmp_path / "half.png")
    damaged = Path(shutil.copytree(model, tmp_path / "damaged"))
    (damaged / "weights" / "tops.safetensors").unlink()
    cases: tuple[tuple[Path, dict[str, Path], str], ...] = (
        (model, {"color": tmp_path / "absent.png"}, "absent.png"),
        (model, {"depth": tmp_path / "cut.png"}, "cut.png"),
        (model, {"labels": tmp_path / "half.png"}, "(100, 100)"),
        (model, {"intrinsics": tmp_path / "word.json"}, "'left'"),
        (tmp_path / "absent", {}, "absent"),
        (tmp_path, {}, "run.json"),
        (damaged, {}, "tops"),
    )
    for path, changes, expected in cases:
        command = ("recognize", "--model", path, *frame_options(images, **changes), "--out", tmp_path / "out")
        assert expected in refused(*command)
        assert not (tmp_path / "out").exists(), expected


@UNFITTED
def test_invalid_training_input_is_refused(meshes: Path, tmp_path: Path, refused: Command) -> None:
    unknown = tmp_path / "names.json"
    unknown.write_text(json.dumps({"mug": "no_such_scan"}))
    broken, bare, full = (tmp_path / name for name in ("broken", "bare", "full"))
    for folder in (broken, bare, full):
        folder.mkdir()
    (broken / "can.ply").write_bytes((meshes / "soup_can_red.ply").read_bytes()[:500])
    (bare / "can.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (full / "file").touch()
    out = tmp_path / "run"
    cases = {
        "no folder": (["--meshes", tmp_path / "absent", "--out", out], "absent"),
        "unknown name": (["--meshes", meshes, "--names", unknown, "--out", out], "no_such_scan"),
        "broken mesh": (["--meshes", broken, "--out", out, *STEPS], "can.ply"),
        "no colour": (["--meshes", bare, "--out", out, *STEPS], "can.obj"),
        "step zero": (["--meshes", meshes, "--out", out, "--azimuth-step", 0], "0"),
        "no source": (["--out", out], "--meshes"),
        "unknown classifier": (["--meshes", meshes, "--out", out, "--classifiers", "shape"], "shape"),
        "no epochs": (["--meshes", meshes, "--out", out, "--epochs", 0], "epochs"),
        "no dataset": (["--dataset", tmp_path / "absent", "--out", out], "absent"),
        "folder in use": (["--meshes", meshes, "--out", full], "full"),
    }
    for case, (arguments, expected) in cases.items():
        assert expected in refused("train", *arguments), case
        assert not out.exists(), case
    # Rendered views are kept for another attempt.
    command = ("train", "--meshes", meshes, "--out", out, *STEPS)
    assert "99" in refused(*command, "--folds", 99, at_once=False)
    assert "batch_size is 100000" in refused(*command, "--batch-size", 100_000, at_once=False)
    assert [p.name for p in out.iterdir()] == ["views"]
    last = ("--epochs", 1, "--batch-size", 16, "--classifiers", "tops", "--embedding", 0)
    assert run_thor2(*command, *last) == 0


@UNFITTED
def test_paper_protocol(meshes: Path, views: Path, tmp_path: Path) -> None:
    """The paper's protocol uses plain views in four mirrors; options replace values of the protocol."""
    cases = {"paper": ("--meshes", meshes, "--paper", *STEPS), "default": ("--dataset", views, "--embedding", 0)}
    for name, options in cases.items():
        assert run_thor2("train", *options, "--out", tmp_path / name, "--epochs", 1, "--classifiers", "ce") == 0
    of = {name: json.loads((tmp_path / name / "run.json").read_text())["record"] for name in ("paper", "default")}
    assert of["paper"]["samples"] == 4 * of["paper"]["dataset"]["views"] == 4 * 3 * 2 * 3
    assert of["paper"]["batch_size"] == 128 and of["default"]["batch_size"] > 100
    # Augmented copies with too few points are left out.
    assert 5 * 3 * 2 * 3 < of["default"]["samples"] / 2 <= 6 * 3 * 2 * 3
    assert of["default"]["samples"] == 2 * of["default"]["dataset"]["views"]


def test_missing_datasets_are_refused(model: Path, tmp_path: Path, refused: Command) -> None:
    for kind in ("uwis", "frames"):
        for path in (tmp_path / "absent", tmp_path):
            assert str(path) in refused("evaluate", kind, path, "--model", model)


def test_colornet(tmp_path: Path, printed: Command, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(colornet, "build", colornet.load_default)  # tests/colornet builds it
    out = printed("colornet", "--out", tmp_path / "network")
    assert "23 raw nodes, 22 regions, 55 edges; equal to the packaged network" in " ".join(out.split())
    assert sorted(p.name for p in (tmp_path / "network").iterdir()) == ["network.npz", "network.png", "similarity.png"]
    assert "already contains" in refused("colornet", "--out", tmp_path / "network")
