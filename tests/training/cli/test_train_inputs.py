"""Inputs of `thor2 train`: labelled instances alone and beside meshes, and invalid ones."""

import json
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from commands import STEPS, Command, run_thor2
from image_files import write_frame
from PIL import Image

from thor2_jax.model.run_directory import load_run
from thor2_jax.recognizer import Recognizer
from training import train_job
from training.cli.options import split_names

pytestmark = pytest.mark.usefixtures("small_classifiers", "small_descriptors")
TINY = ("--embedding", 0, "--orientation-copies", 0, "--classifiers", "ce", "--epochs", 1, "--batch-size", 4, "--quiet")


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


def test_train_on_frames_alone(frames: Path, tmp_path: Path, printed: Command, refused: Command) -> None:
    run = tmp_path / "run"
    command = ("train", "--frames", frames / "0", frames / "1", "--out", run, *TINY)
    with mock.patch.object(train_job, "train_run", wraps=train_job.train_run) as trained:
        out = printed(*command)
    assert list(trained.call_args.args[-1]) == ["brick", "book"]  # whose views are enrolled if there is an embedding
    assert out.count("skipped: ") == 1 and "1: instance 7" in out
    record: Any = load_run(run).record["dataset"]
    assert record["views"] == 4 * 9 and record["frames"]["instances"] == {"brick": 2, "book": 2}
    recognizer = Recognizer.load(run)
    assert recognizer.classes == ("brick", "book") and recognizer.model.answers_by() == "classifiers"
    assert "finished already" in printed(*command)
    message = refused("train", "--frames", frames / "1", frames / "0", "--out", run, *TINY)
    assert "out: " in message and "dataset" in message


@pytest.mark.slow
@pytest.mark.usefixtures("unfitted")
def test_frames_join_meshes(meshes: Path, frames: Path, tmp_path: Path, printed: Command, refused: Command) -> None:
    """The brick has a mesh and frames, the box a mesh, the book frames; left out, it is not enrolled."""
    run = tmp_path / "run"
    command = ("--meshes", meshes, "--frames", frames, "--out", run, *STEPS, *TINY)
    with mock.patch.object(train_job, "train_run", wraps=train_job.train_run) as trained:
        for options, enrolled in (
            ((*command, "--leave-out", "book", "--out", tmp_path / "less"), []),
            (command, ["book"]),
        ):
            assert run_thor2("train", *options) == 0
            assert list(trained.call_args.args[-1]) == enrolled
    assert Recognizer.load(tmp_path / "less").classes == ("box", "brick")
    record: Any = load_run(run).record["dataset"]
    assert {entry["name"] for entry in record["job"]["objects"]} == {"box", "brick"}
    assert record["frames"]["instances"] == {"brick": 2, "book": 2}
    assert Recognizer.load(run).classes == ("box", "brick", "book") and not (run / "views").exists()
    assert "finished already" in printed("train", *command)
    for other in ((), ("--frames", frames / "0")):
        assert "with frames " in refused("train", "--meshes", meshes, *other, "--out", run, *STEPS, *TINY)


def test_names_on_the_command_line_are_normalized() -> None:
    assert split_names("cafe\u0301, mug") == ["caf\u00e9", "mug"]


def test_invalid_inputs(
    meshes: Path, frames: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("meshes").symlink_to(meshes)
    Path("frames").symlink_to(frames)
    Path("full").mkdir()
    write_frame(Path("one/a"), {1: "brick"})
    write_frame(Path("one/b"), {1: "brick"}, 1)
    for name, labels in (("case", {"1": "Brick", "2": "BRICK"}), ("unlabelled", {})):
        frame = write_frame(Path(name, "a"), {1: "brick", 2: "book"})
        (frame / "labels.json").write_text(json.dumps({"labels": labels}))
    Path("full/file").touch()
    Path("names.json").write_text(json.dumps({"mug": "no_such_scan"}))
    Path("case.json").write_text(json.dumps({"Box": "box", "box": "brick"}))
    for arguments, expected in (
        ("", "give --meshes, --dataset or --frames"),
        ("--meshes absent", "absent: no such folder"),
        ("--meshes meshes --names names.json", "no_such_scan"),
        ("--meshes meshes --names case.json", "'Box' and 'box' differ only by case"),
        ("--meshes meshes --leave-out nobody", "--leave-out has 'nobody'"),
        ("--meshes meshes --leave-out brick,box", "--leave-out has box, brick, all"),
        ("--meshes meshes --leave-out brick", "the objects are box; expected at least two"),
        ("--meshes meshes --embedding 9 --distractors meshes", "also a class"),
        ("--meshes meshes --out full", "full"),
        ("--dataset absent --embedding 9 --distractors meshes --mesh-scale 0.5", "absent"),
        ("--meshes meshes --baselines templates", "templates needs a backbone"),
        ("--meshes meshes --baselines thor --azimuth-step 180", "baselines: thor needs views from the side"),
        ("--dataset views --names names.json", "names is names.json"),
        ("--dataset views --polar-step 20", "--polar-step is 20"),
        ("--dataset views --embedding 9", "distractors"),
        ("--dataset views --processes 2", "processes is 2"),
        ("--dataset views --process 1", "process 1;"),
        ("--dataset views --coordinator localhost:1 --processes 2 --process 2", "process is 2"),
        ("--dataset views --coordinator head --processes 2", "coordinator is 'head'; expected HOST:PORT"),
        ("--frames unlabelled", "no frame has"),
        ("--frames one", "the objects are brick; expected at least two"),
        ("--frames frames/0", "one usable instance of 'brick', 'book'"),
        ("--frames case --meshes meshes", "'brick' and 'Brick' differ only by case or form"),
        ("--frames frames --mesh-scale 0.001", "--mesh-scale is 0.001"),
        ("--frames frames --baselines thor", "baselines: thor"),
        ("--frames frames --coordinator localhost:1 --processes 2", "coordinator: "),
        ("--dataset views --frames frames --sequences table.yaml", "sequences is table.yaml; expected none"),
        ("--meshes meshes --out meshes", "--out: meshes already contains"),
        ("--frames frames frames/0", "0 is given twice"),
        ("--frames frames one --embedding 9 --distractors meshes", "also a class"),
    ):
        command = ("train", "--out", tmp_path / "run", *TINY, *STEPS[4:], *arguments.split())
        assert expected in refused(*command), arguments
        assert not (tmp_path / "run").exists() and [path.name for path in Path("full").iterdir()] == ["file"]
