"""Enrolling, forgetting and listing objects on the command line, and what the other commands make of such a run."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, Texts, frame_options, run_thor2
from failures import full_disk
from image_files import frame_of_squares, write_frame, write_frame_files
from recording_files import table_frame, write_recording
from refusals import assert_refused
from rendered_objects import write_box
from written_files import files_of

from thor2_jax.files import locked
from thor2_jax.model.run_directory import load_run
from thor2_jax.recognizer import Recognizer
from training.enrollment import enroll_objects
from training.readers.frames import FrameFolder

pytestmark = pytest.mark.usefixtures("small_classifiers", "small_embedding")

BOX = (0.04, 0.08, 0.06)
"""Sides of a box that has few points, like the objects of the frames."""


@pytest.fixture(scope="module")
def enrolled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with two frames and a run in which their objects are enrolled."""
    folder = tmp_path_factory.mktemp("enrolled")
    for number in range(2):
        write_frame(folder / "frames" / f"00{number}", {1: "brick", 5: "book"}, number)
    assert run_thor2("enroll", "--frames", folder / "frames", "--model", folder / "run") == 0
    return folder


@pytest.fixture
def frames(enrolled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(enrolled / "frames", tmp_path / "frames"))


@pytest.fixture
def model(enrolled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(enrolled / "run", tmp_path / "run"))


def view_counts(model: Path) -> dict[str, int]:
    """Return the number of views of each object that is enrolled in a run."""
    return {name: len(views.clouds) for name, views in Recognizer.load(model).gallery.objects.items()}


def one_frame(frame: Path, instance: int) -> list[object]:
    return [*frame_options(frame), "--instance", instance]


def test_every_labelled_object_is_enrolled_in_a_new_run(model: Path, frames: Path, tmp_path: Path) -> None:
    assert load_run(model).classes == () and load_run(model).classifiers == {}
    assert view_counts(model) == {"brick": 2, "book": 2}
    assert run_thor2("recognize", "--model", model, *frame_options(frames / "001"), "--out", tmp_path / "out") == 0
    answers = json.loads((tmp_path / "out" / "recognition.json").read_text())
    assert [(answer["label"], answer["name"]) for answer in answers] == [(1, "brick"), (5, "book")]


def test_frames_without_labels_are_listed(model: Path, frames: Path, printed: Command) -> None:
    (frames / "001" / "labels.json").unlink()
    for command in (("enroll", "--replace", "--frames", frames), ("evaluate", "frames", frames)):
        assert "frames without labels.json: 1 (001)" in printed(*command, "--model", model).replace("\n", " ")


def test_evaluation_has_a_gallery_column(model: Path, tmp_path: Path, refused: Command) -> None:
    frames = tmp_path / "test"
    write_frame(frames / "a", {2: "book", 3: "brick", 4: "leaf"}, 7)
    command = ("evaluate", "frames", frames, "--model", model, "--out", tmp_path / "report")
    assert run_thor2(*command) == 0
    assert 'depth_scale null, not "900.0"' in refused(*command, "--depth-scale", 900)
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["main"] == "gallery" and report["fusions"] == ["gallery"]
    cell = report["accuracy"][report["rule"]][0]["cells"][0]
    assert cell["instances"] == 2 and cell["accuracy"]["gallery"]["mean"] == 1.0
    assert report["instances"]["no_class"] == {"leaf": 1}
    page = (tmp_path / "report" / "report.html").read_text()
    options = frame_options(frames / "a")
    assert run_thor2("evaluate", "frames", *options, "--model", model, "--out", tmp_path / "one") == 0
    report = json.loads((tmp_path / "one" / "report.json").read_text())
    assert report["dataset"]["path"] == ", ".join(map(str, options[1::2]))
    for given in (options[:2], [*options[:4], *options[6:]]):
        assert "--segment" not in refused("evaluate", "frames", *given, "--model", model)
    assert "<td>" in page and "<tbody></tbody>" not in page and "THOR2 is the fusion" not in page


def test_a_named_object_comes_from_its_label_name(model: Path, frames: Path, printed: Callable[..., str]) -> None:
    """With --extend, views that are stored already are left out; without any other, the gallery does not change."""
    more = ("--model", model, "--frames", frames / "000")
    assert run_thor2("enroll", "red thing", *more, "--label-name", "brick") == 0
    for other, count in ((), 2), ((write_frame(frames / "002", {1: "brick"}, 2),), 3):
        generation = Recognizer.load(model).gallery.generation
        line = "skipped: views of brick that are repeated or enrolled already: 1\n"
        text = printed("enroll", "brick", *more, *other, "--extend")
        assert line in text and "enrolled as new" not in text
        assert view_counts(model) == {"brick": count, "book": 2, "red thing": 1}
        assert (Recognizer.load(model).gallery.generation > generation) == bool(other)
    assert run_thor2("enroll", "brick", *more, "--replace") == 0
    assert view_counts(model)["brick"] == 1
    text = printed("enroll", "brik", *more, "--label-name", "brick", "--extend")
    assert "enrolled as new, since the model has no object with this name: brik\n" in text


def test_frames_without_names(model: Path, frames: Path, tmp_path: Path, refused: Command, printed: Command) -> None:
    """They have the object as their only instance, or --instance names it; so do the segments of a recording.

    With --instance, labels.json is not read.
    """
    for folder in ("000", "001"):
        (frames / folder / "labels.json").unlink()
    error = refused("enroll", "new", frames, "--model", model)
    assert "2 instances" in error and "--instance" in error
    (frames / "000" / "labels.json").write_text("{")
    assert run_thor2("enroll", "new", frames, "--instance", 5, "--model", model) == 0
    (write_frame(tmp_path / "one", {3: "leaf"}) / "labels.json").unlink()
    assert run_thor2("enroll", "only", *frame_options(tmp_path / "one"), "--model", model) == 0
    bag = write_recording(tmp_path / "a.mcap", [table_frame(0), table_frame(3)])
    text = printed("enroll", "box", "--bag", bag, "--instance", 1, "--model", model)
    assert "warning: instance 1 may be a different object in each frame" in text
    assert view_counts(model) == {"brick": 2, "book": 2, "new": 2, "only": 1, "box": 2}


def test_a_mesh_is_enrolled_from_all_sides(model: Path, tmp_path: Path) -> None:
    for name, scale in (("box", 1), ("large", 0.001)):
        mesh = write_box(tmp_path / f"{name}.ply", [side / scale for side in BOX])
        assert run_thor2("enroll", name, "--model", model, "--mesh", mesh, "--mesh-scale", scale) == 0
        views = Recognizer.load(model).gallery.objects[name]
        assert views.source == "mesh" and len(views.clouds) == 2 and len(views.embeddings) == 8
        assert views.surface is not None
        np.testing.assert_allclose(np.ptp(views.surface["table"][0, :3], axis=1), BOX, rtol=0.05)


def test_a_folder_of_meshes(tmp_path: Path) -> None:
    files = {"025_mug/textured.ply": (200, 0, 0), "can.ply": (0, 200, 0), "cafe\u0301/a.ply": (0, 0, 200)}
    for file, color in files.items():
        write_box(tmp_path / "meshes" / file, BOX, color)
    for run, name, folder, names in (
        (tmp_path / "one", [], "025_mug", {"025_mug"}),
        (tmp_path / "one", ["red mug"], "025_mug", {"025_mug", "red mug"}),
        (tmp_path / "two", ["can"], "", {"can"}),
        (tmp_path / "all", [], "", {"025_mug", "can", "caf\u00e9"}),
    ):
        assert run_thor2("enroll", *name, "--mesh", tmp_path / "meshes" / folder, "--model", run) == 0
        objects = Recognizer.load(run).gallery.objects
        assert set(objects) == names
        for each in names:  # has the views of its own mesh
            view = next(iter(objects[each].clouds.views()))
            assert view.colors.mean(axis=0).argmax() == {"can": 1, "caf\u00e9": 2}.get(each, 0)
            surface = objects[each].surface
            assert surface is not None and (float(surface["table"][0, 4].mean()) < 0) == (each == "can")  # a*


def test_arguments_are_checked_before_anything_is_loaded(
    model: Path, frames: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Recognizer, "load", lambda *_, **__: pytest.fail("the run was loaded"))
    for name in ("two/a.ply", "two/b.ply", "one.ply"):
        write_box(tmp_path / name, BOX)
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged.ply").write_text("ply")
    for arguments, text in (
        (("unknown", "--mesh", tmp_path / "one.ply"), "reserved"),
        (("mug",), "--mesh"),
        ((frames, frames), "give --frames FOLDER"),
        (("docs/" + 100 * "漢", "--frames", tmp_path / "absent"), "absent"),
        (("mug", "--frames", frames, "--mesh", tmp_path / "one.ply"), "--mesh"),
        (("mug", "--every", 2, "--mesh", tmp_path / "one.ply"), "--mesh"),
        (("--mesh", tmp_path / "one.ply"), "one.ply is one file, which needs a NAME"),
        (("--mesh", tmp_path / "absent"), "absent does not exist"),
        (("mug", "--mesh", tmp_path / "none.ply"), "no such file"),
        (("mug", "--mesh", tmp_path / "damaged.ply"), "damaged.ply"),
        (("mug", "--mesh", tmp_path / "empty"), "no .glb"),
        (("mug", "--mesh", tmp_path / "two"), "none of a, b is 'mug'"),
        (("mug", "--mesh", tmp_path / "one.ply", "--mesh-scale", 1000), "instance by --mesh-scale 1"),
        (("mug", "--mesh", tmp_path / "one.ply", "--extend", "--replace"), "--extend and --replace are given"),
        (("--frames", frames, "--instance", 1), "name is missing"),
        (("--bag", frames), "name is missing"),
        (("mug", "--frames", frames, "--engine", "ray"), "engine is ray; it belongs to --mesh"),
        (("mug", "--mesh", tmp_path / "one.ply", "--segment", "table"), "segment is table; it belongs to frames"),
    ):
        assert text in refused("enroll", "--model", model, *arguments)


def test_names_that_are_invalid_are_skipped_and_few_views_noted(tmp_path: Path, printed: Command) -> None:
    frame = write_frame(tmp_path / "fr\x1bame", {1: "brick", 5: "book"})
    (frame / "labels.json").write_text('{"labels": {"1": "mug ", "5": "unknown"}}')
    text = printed("enroll", "--frames", frame, "--model", tmp_path / "run")
    assert r"skipped: fr\x1bame: name is 'unknown'" in text and "unknown objects are hardly rejected" in text
    assert "1 object: mug" in text and f"thor2 recognize FRAME --model {tmp_path / 'run'}" in text
    assert Recognizer.load(tmp_path / "run").gallery.names == ("mug",)
    assert run_thor2("evaluate", "frames", frame, "--model", tmp_path / "run", "--out", tmp_path / "report") == 0
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["instances"]["no_class"] == {"unknown": 1} and report["instances"]["scored"] == 1


def test_a_lost_index_is_rebuilt_by_the_command(model: Path, texts: Texts, refused: Command) -> None:
    gallery = model / "gallery"
    (gallery / "index.json").unlink()
    for command in (("objects",), ("forget", "brick")):
        assert f"thor2 objects --reembed --model RUN --gallery {gallery}" in refused(*command, "--model", model)
    table, progress = texts("objects", "--reembed", "--model", model, "--gallery", gallery)
    assert progress.startswith("embed: 0 of 2\n") and "embed: 2 of 2" in progress
    assert all(re.search(rf"{name}\W+2\W+frames\W+20\d\d-\d\d-\d\dT", table) for name in ("brick", "book"))


def test_a_gallery_elsewhere(model: Path, frames: Path, tmp_path: Path, printed: Command, refused: Command) -> None:
    """The run directory does not change, and each gallery has its own objects."""
    before, other = files_of(model), ("--gallery", tmp_path / "other")
    assert "index.json" in refused("objects", "--model", model, *other)
    assert "run directory" in refused("enroll", "--frames", frames, "--model", tmp_path / "none", *other)
    assert not (tmp_path / "none").exists() and not (tmp_path / "other").exists()
    for name, label in (("new", 1), ("old", 5)):
        assert run_thor2("enroll", name, "--model", model, *one_frame(frames / "000", label), *other) == 0
    assert run_thor2("forget", "old", "--model", model, *other) == 0
    assert "'old'" in refused("forget", "old", "--model", model, *other)
    again = f"--model {model} --gallery {tmp_path / 'other'}"  # in the command that each one proposes
    enrolled = printed("enroll", "--model", model, *other, *one_frame(frames / "000", 5), "--", "-old")
    assert enrolled.rstrip().endswith(f"thor2 serve {again}")
    assert f"thor2 enroll {again} -- -old FRAME\n" in printed("forget", "--model", model, *other, "--", "-old")
    lines = printed("objects", "--model", model, *other)
    assert lines.rstrip().endswith(f"thor2 enroll NAME FRAME {again}")
    assert "new" in lines and "old" not in lines and "brick" not in lines
    assert files_of(model) == before and Recognizer.load(model, gallery=tmp_path / "other").classes == ("new",)


def test_bad_input_changes_nothing(model: Path, frames: Path, tmp_path: Path, refused: Command) -> None:
    before, large = files_of(model), write_box(tmp_path / "mm.ply", (100, 200, 150))
    tiny = write_frame_files(tmp_path / "tiny", frame_of_squares({1: (10, 10, 0)}, 3), {1: "leaf"})
    assert "add views to it (--extend)" in refused("enroll", "--frames", frames, "--model", model)
    for given, words in (
        (("new", "--mesh", large), "mm.ply"),
        (("--frames", tiny), "points"),
        (("new", *one_frame(tiny, 1)), "points"),
        (("new", "--frames", frames), "'new'; expected one of book, brick; see --label-name"),
        (("new", *frame_options(frames / "000")), "--instance"),
        (("new", *one_frame(frames / "000", 1), "--label-name", "book"), "--label-name is book and --instance is 1"),
        (("new", *one_frame(frames / "000", 4)), "instance is 4"),
        (("new", *frame_options(tiny, labels=tiny / "color.png")), "error: color: --labels: "),
    ):
        for run in (model, tmp_path / "other"):
            assert words in refused("enroll", *given, "--model", run)
    assert files_of(model) == before and not (tmp_path / "other").exists()


def test_a_gallery_that_cannot_be_written(
    model: Path, frames: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is refused before views are computed."""
    monkeypatch.delattr("training.enrollment.read_instances")
    (tmp_path / "a").touch()
    assert "(--gallery)" in refused("enroll", "--frames", frames, "--model", model, "--gallery", tmp_path / "a" / "b")
    monkeypatch.setattr("thor2_jax.gallery.store.LOCK_SECONDS", 0.1)
    with locked(model / "gallery"):
        assert "another process" in refused("enroll", "--frames", frames, "--model", model)


def test_a_run_that_another_command_creates_meanwhile(model: Path, frames: Path, tmp_path: Path) -> None:
    def create(*_: object) -> None:
        shutil.copytree(model, tmp_path / "other", dirs_exist_ok=True)

    assert_refused("created by another", enroll_objects, tmp_path / "other", FrameFolder(frames), progress=create)
    assert files_of(tmp_path / "other") == files_of(model)


def test_progress_begins_before_views_are_rendered(model: Path, tmp_path: Path) -> None:
    steps: list[object] = []

    def pool(function: Any, tasks: Any) -> Any:
        yield from (steps.append("render") or function(task) for task in tasks)

    meshes = {"box": write_box(tmp_path / "box.ply", BOX)}
    enroll_objects(model, meshes, pool=pool, progress=lambda stage, done, *_: steps.append(done))
    assert steps == [0, "render", 1]


def test_a_full_disk_leaves_no_run(frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, texts: Texts) -> None:
    for step in ("_write_durably", "write_text"):
        for before in ([], [tmp_path / step / "run"]):  # the directory is new, or there and empty
            (tmp_path / step / "run" if before else tmp_path / step).mkdir()
            with monkeypatch.context() as patch:
                patch.setattr(f"thor2_jax.gallery.store.{step}", full_disk)
                _, err = texts("enroll", "--frames", frames, "--model", tmp_path / step / "run", status=2)
            assert "No space left" in err
            assert list((tmp_path / step).rglob("*")) == before
