"""`thor2 train --frames`: labelled instances alone and beside meshes, with tiny configurations."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import Command, run_thor2, write_box, write_frame
from PIL import Image

from thor2_jax.model.run_directory import load_run
from thor2_jax.recognizer import Recognizer

pytestmark = pytest.mark.usefixtures("small_classifiers", "small_descriptors")
TINY = ("--embedding", 0, "--orientation-copies", 0, "--classifiers", "ce", "--epochs", 1, "--batch-size", 4, "--quiet")
STEPS = ("--azimuth-step", 180, "--polar-step", 90, "--workers", 1)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return two frames of a brick and a book; the second one has a leaf of 16 pixels, too."""
    folder = tmp_path_factory.mktemp("frames")
    write_frame(folder / "0", {1: "brick", 5: "book"}, 0)
    second = write_frame(folder / "1", {1: "brick", 5: "book", 7: "brick"}, 1)
    mask = np.asarray(Image.open(second / "mask.png")).copy()
    mask[mask == 7] = 0
    mask[:4, :4] = 7
    Image.fromarray(mask).save(second / "mask.png")
    return folder


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    for name, size in (("brick", (0.1, 0.06, 0.2)), ("box", (0.1, 0.1, 0.1))):
        write_box(folder / f"{name}.ply", size)
    return folder


def record_of(run: Path) -> dict[str, Any]:
    return dict(load_run(run).record["dataset"])


def test_train_on_frames_alone(frames: Path, tmp_path: Path, printed: Command, refused: Command) -> None:
    run = tmp_path / "run"
    command = ("train", "--frames", frames / "0", frames / "1", "--out", run, *TINY)
    out = printed(*command)
    assert out.count("skipped: ") == 1 and "1: instance 7" in out
    record = record_of(run)
    assert record["views"] == 4 * 9 and record["frames"]["instances"] == {"brick": 2, "book": 2}
    recognizer = Recognizer.load(run)
    assert recognizer.classes == ("brick", "book") and recognizer.model.answers_by() == "classifiers"
    assert "finished already" in printed(*command)
    message = refused("train", "--frames", frames / "0", frames / "0", "--out", run, *TINY)
    assert "out: " in message and "dataset" in message


@pytest.mark.slow
@pytest.mark.usefixtures("unfitted")
def test_frames_join_the_views_of_meshes(
    meshes: Path, frames: Path, tmp_path: Path, printed: Command, refused: Command
) -> None:
    """The brick has a mesh and frames, the box a mesh, the book frames."""
    run = tmp_path / "run"
    command = ("--meshes", meshes, "--frames", frames, "--out", run, *STEPS, *TINY)
    assert run_thor2("train", *command) == 0
    record = record_of(run)
    assert {entry["name"] for entry in record["job"]["objects"]} == {"box", "brick"}
    assert record["frames"]["instances"] == {"brick": 2, "book": 2}
    assert Recognizer.load(run).classes == ("box", "brick", "book") and not (run / "views").exists()
    assert "finished already" in printed("train", *command)
    assert "with frames " in refused("train", "--meshes", meshes, "--out", run, *STEPS, *TINY)
    other = ("--meshes", meshes, "--frames", frames / "0", "--out", run, *STEPS, *TINY)
    assert "with frames " in refused("train", *other)


def test_frames_that_cannot_be_trained_on_are_refused(
    meshes: Path, frames: Path, tmp_path: Path, refused: Command
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    one = tmp_path / "one"
    write_frame(one / "a", {1: "brick"})
    write_frame(one / "b", {1: "brick"}, 1)
    case = tmp_path / "case" / "a"
    write_frame(case, {1: "brick", 2: "book"})
    (case / "labels.json").write_text(json.dumps({"labels": {"1": "Brick", "2": "BRICK"}}))
    (tmp_path / "reserved").mkdir()
    shutil.copy(meshes / "box.ply", tmp_path / "reserved" / "unknown.ply")
    unlabelled = tmp_path / "unlabelled" / "a"
    write_frame(unlabelled, {1: "brick"})
    (unlabelled / "labels.json").write_text('{"labels": {}}')
    out = tmp_path / "run"
    for words, options in (
        ("give one of --meshes and --dataset, --frames, or both", ()),
        ("has no color.png", ("--frames", empty)),
        ("no frame has", ("--frames", unlabelled)),
        ("the objects are brick; expected at least two", ("--frames", one)),
        ("the objects are book; expected", ("--frames", frames, "--leave-out", "brick")),
        ("leave_out has 'nobody'", ("--frames", frames, "--leave-out", "nobody")),
        ("leave_out has 'nobody'", ("--meshes", meshes, "--leave-out", "nobody")),
        ("one usable instance", ("--frames", frames / "0")),
        ("'brick' and 'Brick' differ only by case or form", ("--meshes", meshes, "--frames", case)),
        ("name is 'unknown', which is reserved", ("--meshes", tmp_path / "reserved", "--frames", one)),
        ("azimuth-step is 30", ("--frames", frames, "--azimuth-step", 30)),
        ("mesh-scale is 0.001", ("--frames", frames, "--mesh-scale", 0.001)),
        ("baselines: thor", ("--frames", frames, "--baselines", "thor")),
        ("coordinator: ", ("--frames", frames, "--coordinator", "localhost:1", "--processes", 2)),
        ("sequences is", ("--frames", frames, "--sequences", tmp_path / "table.yaml")),
        ("also a class", ("--frames", frames, frames / "0", "--distractors", meshes)),
    ):
        distractors = () if "--distractors" in options else TINY[:2]
        assert words in refused("train", *options, "--out", out, *distractors), options
        assert not out.exists()
