"""Evaluations with stand-ins for recognizers: interrupted, resumed, refused; answers, the page and its pictures."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import json_lines
from image_files import frame_of_squares, label_image, small_frame, write_frame_files
from PIL import Image
from refusals import assert_refused
from toy_recognizers import NamesInOrder, UntaughtRecognizer, described
from written_files import ParsedPage, files_of, killed

import thor2_jax as thor2
from thor2_jax.files import LOCK, locked
from thor2_jax.frames.overlay import Annotation
from training.evaluation.answers import AnswerFile
from training.evaluation.job import answer_frames, evaluate_dataset
from training.evaluation.page import upright
from training.evaluation.runs import Run
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrame, LabelledFrames

CLASSES = ("bowl", "can", "mug")


class Frames(LabelledFrames):
    """A dataset of given frames, which records the numbers of the frames that are read."""

    def __init__(self, frames: list[LabelledFrame]) -> None:
        self.identifiers, self.frames = [frame.identifier for frame in frames], frames
        self.numbers: list[int] = []

    def read(self, number: int) -> tuple[thor2.RGBDFrame, Mapping[int, str], Mapping[str, str]]:
        self.numbers.append(number)
        return self.frames[number].frame, self.frames[number].truth, self.frames[number].attributes


def toy_frames(n: int, prefix: str = "frame") -> Frames:
    """Frames with labels 1 to 3, whose first pixel is the frame number; 3 is unknown, 2 is missing in every fourth."""
    frames = []
    for number in range(n):
        first, second, third = np.random.default_rng(number).integers(0, 256, (3, 20, 20, 3))
        squares = {1: (5, 5, first), 3: (2, 40, third)} | ({2: (25, 30, second)} if number % 4 else {})
        frame = frame_of_squares(squares, side=20, shape=(48, 64))
        frame.color[0, 0] = number
        truth = {1: CLASSES[number % 3], 2: "mug", 3: "dragon"}
        frames.append(LabelledFrame(f"{prefix}{number}", frame, truth, {"light": str(number % 2)}))
    return Frames(frames)


class ToyRecognizer(UntaughtRecognizer):
    """Returns random probabilities, seeded by run and frame, and logs each frame that it describes."""

    def __init__(self, seed: int, log: Path, features: tuple[str, ...], stop_at: int | None = None) -> None:
        super().__init__(CLASSES, features)
        self.seed, self.log, self.stop_at = seed, log, stop_at

    def describe(self, frame: Any) -> Any:
        number = int(frame.color[0, 0, 0])
        if number == self.stop_at:
            raise KeyboardInterrupt
        with self.log.open("a") as file:
            file.write(f"{number}\n")
        return described(super().describe(frame).instances, number)

    def probabilities(self, oriented: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, oriented])
        return {name: rng.dirichlet(np.ones(3), 4).astype(np.float32) for name in self.run.classifiers}


def toys(log: Path, stop_at: int | None = None) -> list[Run]:
    """Return two runs; the second has no CE."""
    features = (("ce", "tops", "tops2"), ("tops", "tops2"))
    return [Run(f"run{k}", f"digest{k}", ToyRecognizer(k, log, f, stop_at)) for k, f in enumerate(features)]  # type: ignore[arg-type]


DESCRIPTION = {"kind": "frames", "path": "toys"}


def evaluate_toys(folder: Path, dataset: int | LabelledFrames, stop_at: int | None = None) -> dict[str, Any]:
    """Evaluate two runs on a dataset, or on a number of frames, and return the report."""
    folder.mkdir(exist_ok=True)
    frames = toy_frames(dataset) if isinstance(dataset, int) else dataset
    return evaluate_dataset(toys(folder / "log", stop_at), frames, DESCRIPTION, folder / "report")


def without_times(report: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in report.items() if name != "speed"}


def test_stopped_evaluation_resumes_with_the_same_result(tmp_path: Path) -> None:
    whole, report = evaluate_toys(tmp_path / "whole", 9), tmp_path / "stopped" / "report"
    report.mkdir(parents=True)
    (report / ".answers.x.jsonl").write_text('{"data')  # of a process that was killed before it wrote anything
    with pytest.raises(KeyboardInterrupt):
        evaluate_toys(tmp_path / "stopped", 9, stop_at=5)
    assert not (report / "report.json").exists()
    assert len((report / "answers.jsonl").read_text().splitlines()) == 1 + 5
    with (report / "answers.jsonl").open("a") as file:
        file.write('{"frame": "frame5", "attrib')  # as after a kill during a write
    (report / "frames").mkdir()
    for folder in (report, report / "frames"):
        killed(folder)
    dataset = toy_frames(9)
    resumed = evaluate_toys(tmp_path / "stopped", dataset)
    assert (tmp_path / "stopped" / "log").read_text().split() == [str(k) for k in range(9)]
    assert dataset.numbers[:4] == [5, 6, 7, 8]  # the pictures are drawn afterwards
    assert without_times(resumed) == without_times(whole)
    for pictures in ("frames", "confusions"):
        assert files_of(report / pictures) == files_of(tmp_path / "whole" / "report" / pictures) != {}
    assert without_times(evaluate_toys(tmp_path / "stopped", 9)) == without_times(whole)
    assert len((tmp_path / "stopped" / "log").read_text().split()) == 9
    assert {p.name for p in report.rglob(".*")} == {LOCK, ".answers.x.jsonl"}


@pytest.mark.usefixtures("drawn_pictures")
@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.slow), 15])
def test_page_for_datasets_of_any_size(tmp_path: Path, n: int) -> None:
    directory, stages = tmp_path / "report", list[tuple[str, int, int, str]]()
    runs, progress = toys(tmp_path / "log"), lambda *stage: stages.append(stage)
    report = evaluate_dataset(runs, toy_frames(n), {"kind": "uwis", "path": "toys"}, directory, progress)
    assert [done for _, done, _, _ in stages] == list(range(n + 1)) and "frames/s" in stages[-1][3]
    assert report == json.loads((directory / "report.json").read_text())
    page = ParsedPage((directory / "report.html").read_text())
    assert page.open == [] and not page.tags & {"script", "link"}
    assert all(p["alt"] and (directory / str(p["src"])).is_file() for p in page.pictures)
    shown = [p for p in page.pictures if str(p["src"]).startswith("frames/")]
    assert len(shown) == min(n, 12) and len(report["shown"]) == len(shown)
    crops = {str(p["src"]) for p in page.pictures if str(p["src"]).startswith("confusions/")}
    assert len(crops) == len(report["worst"]) and report["worst"][0]["truth"] == "dragon"
    assert "THOR2 (thor2 recognize)" in page.text
    assert "known-unknown.png" in {p["src"] for p in page.pictures} and "Unknown objects" in page.text
    assert "Placements" not in page.text  # every toy is arranged anew
    whole = report["accuracy"][report["rule"]][0]["cells"][0]["accuracy"]["THOR2"]
    assert f"{whole['mean']:.3f} ±\u00a0{whole['std']:.3f}" in page.text
    # The toys have no environment, so only rows on the whole dataset match: of tables 4, 7, 9 and of THOR's paper.
    assert [table["number"] for table in report["published_tables"]] == [4, 7, 9, None]
    headings = [text.split(":")[0] for text in page.text if text.startswith("Published")]
    assert headings == [*(f"Published table {n}" for n in (4, 7, 9)), "Published"]
    assert {"THOR2, published", "62.58 ±\u00a00.36", "CE+TOPS, published", "57.68 ±\u00a00.25"} <= set(page.text)
    assert any("2408.01579" in text and "8,456 frames" in text for text in page.text)
    for picture in page.pictures:
        with Image.open(directory / str(picture["src"])) as image:
            image.load()
            assert max(image.size) <= 2000


def test_a_table_with_few_rows_is_upright() -> None:
    assert upright((["", "n", "a", "b"], [["all", "9", ".1", ".2"]])) == (
        ["", "all"], [["n", "9"], ["a", ".1"], ["b", ".2"]],
    )  # fmt: skip
    table = ["", "n", "a"], [["all", "9", ".1"]]
    assert upright(table) is table


def test_a_dataset_whose_only_object_has_no_pixels(tmp_path: Path) -> None:
    """A known object has a page; an unknown one is refused, with the names of the dataset and of the runs."""
    frame = dataclasses.replace(small_frame(), labels=np.zeros((90, 120), np.uint8))
    evaluate_toys(tmp_path / "known", Frames([LabelledFrame("f", frame, {1: "mug"}, {})]))
    assert ParsedPage((tmp_path / "known" / "report" / "report.html").read_text()).open == []
    dragons = Frames([LabelledFrame("f", frame, {1: "dragon"}, {})])
    assert_refused("dragon.*bowl, can, mug", evaluate_toys, tmp_path / "unknown", dragons)
    assert not (tmp_path / "unknown" / "report" / "report.json").exists()


def test_answers_for_changed_files_are_refused(tmp_path: Path) -> None:
    """The message names the file; unchanged files are no reason to recompute anything."""
    for number in range(3):
        write_frame_files(tmp_path / "frames" / f"{number}", small_frame(number), {1: "mug"})
    dataset, report, depth = FrameFolder(tmp_path / "frames"), tmp_path / "report", tmp_path / "frames/1/depth.png"
    first = evaluate_toys(tmp_path, dataset)
    answers, content = (report / "answers.jsonl").read_bytes(), depth.read_bytes()
    assert without_times(evaluate_toys(tmp_path, dataset)) == without_times(first)
    for change in (lambda: depth.write_bytes(b"changed"), depth.unlink):
        change()
        assert_refused(rf"^out: .*{depth}", evaluate_toys, tmp_path, dataset)
    depth.write_bytes(content)
    header, *lines = json_lines(answers.decode())
    lines = [{name: value for name, value in line.items() if name != "files"} for line in lines]  # of version 0.1.0
    (report / "answers.jsonl").write_text("".join(json.dumps(line) + "\n" for line in (header, *lines)))
    evaluate_toys(tmp_path, dataset)


def test_an_unreadable_first_frame_leaves_no_directory(tmp_path: Path) -> None:
    folder = write_frame_files(tmp_path / "frames" / "0", small_frame(), {1: "mug"})
    (folder / "depth.png").write_bytes(b"damaged")
    assert_refused("depth", evaluate_toys, tmp_path, FrameFolder(tmp_path / "frames"))
    assert not (tmp_path / "report").exists()


def test_outlines_show_correct_and_incorrect_answers(tmp_path: Path) -> None:
    from training.evaluation.frame_pictures import CORRECT, INCORRECT, draw_crop, draw_judged

    color = np.full((60, 90, 3), 128, np.uint8)
    labels = label_image((1, 20, 50, 5, 40), (2, 20, 50, 50, 85), shape=(60, 90))
    judged = [Annotation(2, INCORRECT, "b (c)"), Annotation(7, INCORRECT, "gone"), Annotation(1, CORRECT, "a")]
    draw_judged(color, labels, judged, tmp_path / "f.jpg")
    pixels = np.asarray(Image.open(tmp_path / "f.jpg").convert("RGB")).astype(int)
    for row, paint in (((49, 20), CORRECT), ((49, 70), INCORRECT), ((40, 20), (128, 128, 128))):
        assert np.abs(pixels[row] - paint).max() < 40
    draw_crop(color, np.indices((60, 90)).sum(axis=0) == 148, tmp_path / "c.jpg")  # the last pixel
    with Image.open(tmp_path / "c.jpg") as image:
        assert max(image.size) == 240


def test_answers_of_another_evaluation_are_refused(tmp_path: Path) -> None:
    evaluate_toys(tmp_path, 3)
    runs, report = toys(tmp_path / "log"), tmp_path / "report"
    before = (report / "answers.jsonl").read_bytes()
    other = [Run("run0", "another digest", runs[0].recognizer), runs[1]]
    for value, evaluated, n, description in (
        ("another digest", other, 3, DESCRIPTION),
        ("elsewhere", runs, 3, DESCRIPTION | {"path": "elsewhere"}),
        ("frames 3, not 4", runs, 4, DESCRIPTION),
        ("digest1", runs[:1], 3, DESCRIPTION),
    ):
        assert_refused(f"^out: .*{value}", evaluate_dataset, evaluated, toy_frames(n), description, report)
    assert (report / "answers.jsonl").read_bytes() == before
    (report / "answers.jsonl").write_bytes(b"".join(before.splitlines(keepends=True)[:3]))
    assert_refused("'frame0'.*'photo0'", evaluate_toys, tmp_path, toy_frames(3, "photo"))


def test_directories_of_others_are_refused(tmp_path: Path) -> None:
    """These have files of the user, or another process is evaluating into them."""
    (tmp_path / "report").mkdir()
    with locked(tmp_path / "report"):
        assert_refused("^out: ", evaluate_toys, tmp_path, 1)
    (tmp_path / "report" / "thesis.tex").touch()
    assert_refused("^out: ", evaluate_toys, tmp_path, 1)
    assert {p.name for p in (tmp_path / "report").iterdir()} == {"thesis.tex", LOCK}


@pytest.mark.parametrize("content", ["", "[1]\n", "[" * 100_000 + "\n", "{}\n{}\n", '{"a": 1}\nnonsense\n'])
def test_damaged_answer_file_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "answers.jsonl").write_text(content)
    assert_refused("damaged", AnswerFile, tmp_path / "answers.jsonl", {"a": 1})
    assert (tmp_path / "answers.jsonl").read_text() == content


def test_page_of_a_video_and_of_stored_thresholds(tmp_path: Path) -> None:
    """Two frames of one unmoved object are one placement; the threshold 0.5 is in the header."""
    video = Frames([LabelledFrame(f"v/{k}", toy_frames(2)[1].frame, {2: "mug"}, {}) for k in range(2)])
    runs = toys(tmp_path / "log")
    for run in runs:
        run.recognizer.unknown_below = 0.5  # type: ignore[attr-defined]
    report = evaluate_dataset(runs, video, DESCRIPTION, tmp_path / "report")
    page = ParsedPage((tmp_path / "report" / "report.html").read_text())
    assert report["placements"]["count"] == 1 and report["placements"]["steadiness"]["THOR2"]["mean"] == 1
    assert page.open == [] and {"Placements", "Unknown objects"} <= set(page.text) and "details" in page.tags
    assert any(text.startswith("threshold 0.500") for text in page.text)


def test_every_labelled_instance_gets_an_answer() -> None:
    """Labels 2, 4 and 7 are rows 0, 1 and 2; 9 is unusable, 11 an unknown object, 12 has no pixels."""
    truth = {7: "bowl", 2: "mug", 4: "can", 9: "mug", 11: "dragon", 12: "can"}
    frame = LabelledFrame("f1", small_frame(), truth, {"light": "1"})
    tops = [[0.6, 0.3, 0.1], [0.5, 0.4, 0.1], [0.2, 0.7, 0.1], [1, 0, 0]]
    tops2 = [[0.1, 0.7, 0.2], [0.1, 0.1, 0.8], [0.3, 0.4, 0.3], [1, 0, 0]]
    lost = dict.fromkeys((9, 11), "too few points")
    instances = [SimpleNamespace(label=k, reason=lost.get(k), occluded=k == 4, points=[1]) for k in (2, 4, 7, 9, 11)]
    recognizer: Any = UntaughtRecognizer(("mug", "bowl", "can"), ("tops", "tops2"))
    recognizer.describe = lambda _: described(instances, {"tops": np.array(tops), "tops2": np.array(tops2)})
    recognizer.probabilities = lambda table: table
    (answers,) = answer_frames([Run("run", "", recognizer)], [frame])
    assert answers.frame == "f1" and answers.attributes == {"light": "1"}
    assert [(i.label, i.truth) for i in answers.instances] == sorted(truth.items())
    reasons = [None] * 3 + ["too few points"] * 2 + ["no pixels in the label image"]
    assert [i.reason for i in answers.instances] == reasons
    assert [i.label for i in answers.instances if i.occluded] == [4]
    probabilities = [i.probabilities for i in answers.instances]
    np.testing.assert_allclose(probabilities[:3], np.stack([tops, tops2], axis=1)[:3], rtol=1e-6)
    assert probabilities[3:] == [None] * 3
    recognizer.describe = lambda _: described(instances, {"tops": np.array(tops), "tops2": np.array(tops2)}, overflow=1)
    (answers,) = answer_frames([Run("run", "", recognizer)], [frame])  # recognition gives none of these a name
    assert [i.probabilities for i in answers.instances] == [None] * 6 and "overflow" in str(answers.instances[0].reason)
    recognizer.describe, recognizer.probabilities = lambda _: described(instances[3:], {}), None  # is not called
    (answers,) = answer_frames([Run("run", "", recognizer)], [frame])
    assert [i.probabilities for i in answers.instances] == [None] * 6


def test_position_is_the_median_of_the_points() -> None:
    """Two pixels at 2 m and one at 9 m, which belongs to the background; one without depth does not count."""
    depth, labels = np.zeros((2, 3, 5), np.uint16)
    depth[1, 1:4] = 2000, 2000, 9000
    labels[1], labels[2, 0] = [0, 1, 1, 1, 1], 2
    frame = thor2.RGBDFrame(np.zeros((3, 5, 3), np.uint8), depth, labels, thor2.Intrinsics(10.0, 10.0, 0.0, 0.0))
    truth = dict.fromkeys((1, 2, 3), "mug")
    (answers,) = answer_frames([Run("run", "", NamesInOrder())], [LabelledFrame("f", frame, truth, {})])
    assert [instance.position for instance in answers.instances] == [[0.4, 0.2, 2.0], None, None]
