"""`thor2 explain`: pages that need no other file, and nothing on disk after errors."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import Command, Texts, run_thor2
from failures import full_disk
from image_files import write_frame
from small_runs import with_surfaces
from written_files import ParsedPage, files_of_the_user

import thor2_jax as thor2
from thor2_jax.model.run_directory import load_run, save_run
from training.cli.app import option_arguments
from training.frame_recognition import RecognizerArguments
from training.reports import explanation_page


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    return write_frame(tmp_path / "table", {1: "leaf", 4: "book"})


@pytest.mark.slow
@pytest.mark.usefixtures("drawn_pictures", "small_buckets")
def test_a_page_for_every_instance(
    model: Path, frame: Path, tmp_path: Path, printed: Command, refused: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is left after an error."""
    out, compared = tmp_path / "out", tmp_path / "compared"
    save_run(with_surfaces(load_run(model)), compared)
    *pages, last = printed("explain", "--model", compared, frame, "--out", out).splitlines()
    assert sorted(path.name for path in (out / "table").iterdir()) == ["1", "4"] and len(pages) == 2
    assert "thor2 enroll" in last
    for label in (1, 4):
        directory = out / "table" / str(label)
        page = ParsedPage((directory / "explanation.html").read_text())
        assert page.open == [] and "script" not in page.tags
        assert len(page.pictures) > 6
        assert all(str(picture["src"]).startswith("data:image/png;base64,") for picture in page.pictures)
        record = json.loads((directory / "explanation.json").read_text())
        assert record["label"] == label and record["explained_name"] in ("bowl", "mug", "plate")
        pictures = sorted(path.stem for path in directory.glob("*.png"))
        assert len(pictures) == len(page.pictures) and {"photo", "cloud", "check", "surfaces", "network"} <= {*pictures}
        assert "Does it fit the surfaces?" in page.text and len(record["surfaces"]) == 3
        assert not list(directory.glob(".*"))
    monkeypatch.setattr(explanation_page, "write_page", full_disk)
    command = ("explain", "--model", model, frame, "--instance", 1, "--out", tmp_path / "deep" / "out")
    error = refused(*command, at_once=False)
    assert "No space left" in error and not (tmp_path / "deep").exists()


def test_folders_of_the_user_stay(model: Path, frame: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    values = {"label": 1, "explained_name": "mug", "faithfulness": {}}
    explanation = SimpleNamespace(title="mug", as_json=lambda: values)
    monkeypatch.setattr("thor2_jax.explanation.explain.explain", lambda *_: explanation)
    monkeypatch.setattr(explanation_page, "write_page", lambda unfinished, **_: unfinished.write_text("a page"))
    for name, nothing in (("pictures", []), ("_lead", ""), ("_page_sections", [])):
        monkeypatch.setattr(explanation_page, name, lambda *_, nothing=nothing: nothing)
    command = ("explain", "--model", model, frame.parent, "--out", frame.parent, "--instance")
    with files_of_the_user(frame / "1/scan.ply", frame / "4/photo.png"):
        for _ in range(2):  # The second explanation replaces the first one.
            assert run_thor2(*command, 1) == 0
            names = sorted(path.name for path in (frame / "1").iterdir())
            assert names == ["explanation.html", "explanation.json", "scan.ply"]
        assert "photo.png" in refused(*command, 4)
        other = write_frame(frame.parent / "other", {1: "book"})  # beside the pages of an earlier call
        assert run_thor2("explain", "--model", model, other, "--out", frame.parent) == 0


def test_names_without_enrolled_views_are_left_out() -> None:
    top = {"embedding": [("mug", 0.9), ("bowl", 0.1)], "gallery": [("mug", 1.0), ("bowl", 0.0)]}
    answer = thor2.Recognition(1, "mug", 0.9, top=top)
    assert explanation_page._answer_table(answer)[1] == [["1", "mug 90.0 %", "mug >99.9 %"], ["2", "bowl 10.0 %", ""]]


def test_texts_of_a_page() -> None:
    """Advice on a wrong name, and what is said if surfaces or an enrolled object decided against the best score."""
    for occluded, other, changes in ((True, "bowl", [SimpleNamespace(kind="color")]), (False, None, [])):
        answer = SimpleNamespace(label=7, occluded=occluded)
        explanation: Any = SimpleNamespace(recognition=answer, name="mug", runner_up=other, changes=changes)
        advice = explanation_page._advice(explanation)
        assert "thor2 enroll NAME FRAME --instance 7" in advice
        assert [part in advice for part in ("mug and bowl", "thor2 adapt", "--track")] == [occluded] * 3
    for best, text in ((0, "No shift of the colours"), (1, "The explained scores alone would give bowl")):
        scores = SimpleNamespace(names=("mug", "bowl"), of_instances=lambda _, best=best: np.eye(2)[[best]])
        explanation = SimpleNamespace(scores=scores, instance=None, name="mug", runner_up="bowl", changes=())
        assert explanation_page._changes_text(explanation).startswith(text)
    for other, lead, words in (
        *(("bowl", 0.25, "mug is 0.25 more similar "), ("bowl", -0.25, "mug is 0.25 less similar ")),
        *(("bowl", -0.004, "mug is as similar "), (None, 0.004, "mug (cosine) is 0.00, and no other object")),
    ):
        assert words in explanation_page._similarity_text("mug", other, lead)
    explanation = SimpleNamespace(scores=SimpleNamespace(unit="log-odds"))
    for loss, words in ((0.3, "loses 0.30"), (-0.01, "gains 0.01"), (-0.001, "loses 0.00")):
        assert explanation_page.loss_text(explanation, loss) == f"{words} in log-odds"


def test_options_of_recognition_hold_and_the_next_command_is_shown(
    model: Path, frame: Path, tmp_path: Path, texts: Texts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next command has an instance that was explained."""
    seen = []

    def explain(recognizer: thor2.Recognizer, _: Any, label: int) -> SimpleNamespace:
        seen.append((recognizer.model.unknown_below, recognizer.model.answer_by, recognizer.objects.directory))
        if label == 4:
            raise thor2.InputError("too few points")
        return SimpleNamespace(title="mug " * 40)

    monkeypatch.setattr("thor2_jax.explanation.explain.explain", explain)
    monkeypatch.setattr(explanation_page, "write_explanation", lambda *_: None)
    gallery = tmp_path / "gallery"
    thor2.Recognizer.load(model, gallery=gallery).objects.add({})
    given = option_arguments(**vars(RecognizerArguments(model, 0.9, "classifiers", gallery)))
    text, progress = texts("explain", *given, frame, "--out", tmp_path / "out")
    assert "explain frame 1 of 1: 0 of 2, instance 1\n" in progress
    assert f" NAME {frame} --instance 1 " in text and f"pages in {tmp_path / 'out'}: 1; " in text
    assert f"mug : {tmp_path / 'out' / 'table' / '1' / 'explanation.html'}\n" in text
    assert seen == [(0.9, "classifiers", gallery)] * 2
    write_frame(tmp_path / "other", {1: "book"})
    assert " NAME FRAME --instance 1 " in texts("explain", *given, tmp_path, "--out", tmp_path / "more")[0]


def test_bad_input(model: Path, frame: Path, tmp_path: Path, refused: Command, texts: Texts) -> None:
    empty = write_frame(tmp_path / "nothing", {})
    _, err = texts("explain", "--model", model, empty, "--out", tmp_path / "out", status=2)
    assert err.startswith("skipped: nothing: ")
    out = tmp_path / "out"
    command = ("explain", "--model", model, frame, "--out", out, "--quiet")
    assert "table: --instance is 9; expected one of 1, 4" in refused(*command, "--instance", 9)
    assert "--answer-by is gallery" in refused(*command, "--answer-by", "gallery")
    assert "none has no index.json" in refused(*command, "--gallery", tmp_path / "none")
    (frame / "mask.png").unlink()
    assert "error: table: labels is None" in refused(*command)
    out.mkdir()  # The error has not created it.
    (out / "mine.txt").write_text("x")
    assert "mine.txt" in refused(*command)
