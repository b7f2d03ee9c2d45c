"""Summaries of the benchmarks against values by hand, their bad arguments, and those of cameras and `thor2 doctor`."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from image_files import small_frame, write_frame_files
from refusals import assert_refused
from small_runs import untrained_run
from toy_recognizers import ToyRun, toy_answer

import thor2_jax as thor2
from benchmarks import adaptation, cameras, explanation, levers, paper, segmentation
from benchmarks.doctor import DAMAGES, run
from benchmarks.run_service import multipart_request
from benchmarks.tracking import METHODS, VIEWS, summarize_scenes
from thor2_jax.explanation.attributions import Attributions
from thor2_jax.model.run_directory import save_run
from thor2_jax.service.hosts import is_allowed_host
from training.augmentation.simulated_cameras import CHOOSE
from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.readers.frames import frame_files
from training.readers.labelled import LabelledFrame


def test_faithful_instances_are_counted() -> None:
    values = np.zeros(3, np.float32)
    checks = [Attributions(values, *one) for one in ((5.0, 2.0, 0.5), (5.0, 0.1, 0.5), (1.0, -0.1, -0.4))]
    assert explanation.summary(checks) == {
        "instances": 3,
        "faithful": 2 / 3,
        "loss_without_most_attributed_tenth": 0.1,
        "loss_without_random_tenth": 0.5,
    }


def test_affected_cameras_are_those_that_lost_enough() -> None:
    rows = {"original": (0.9, 0.9), "dim": (0.86, 0.8), "pale": (0.8, 0.9), "worn": (0.7, 0.74)}
    results = adaptation.summary({name: {"before": before, "after": after} for name, (before, after) in rows.items()})
    assert results["number of affected cameras"] == 2
    assert results["affected cameras"] == pytest.approx(0.07)
    assert results["all cameras"] == pytest.approx((-0.06 + 0.1 + 0.04) / 3)
    assert results["worst"] == pytest.approx(-0.06) and results["original"] == 0


def test_an_object_keeps_the_answer_of_its_last_view() -> None:
    late, always = dict.fromkeys(METHODS, [False, True]), dict.fromkeys(METHODS, [True] * VIEWS)
    rows = [{"occlusion": "high", "correct": late}, {"occlusion": "none", "correct": always}]
    results = summarize_scenes(rows)
    assert results["all"]["fused"] == {"accuracy": [0.5, *[1.0] * (VIEWS - 1)], "views needed": 2}
    assert results["high"]["objects"] == 1 and results["high"]["merged"]["accuracy"][0] == 0


def test_pieces_are_compared_with_instances() -> None:
    """Three instances of 20 pixels: exact, in two pieces, and in one piece with a fourth one; the last is thin."""
    truth, pieces = np.zeros((10, 12), np.uint8), np.zeros((10, 12), np.int32)
    truth[0:2, 0:10], truth[3:5, 0:10], truth[6:8, 0:10], truth[8:10, 0:10] = 1, 2, 3, 7
    pieces[0:2, 0:10], pieces[3:5, 0:5], pieces[3:5, 5:10], pieces[6:10, 0:10], pieces[0:10, 11] = 1, 2, 3, 4, 5
    images = np.zeros((10, 12, 3), np.uint8), np.full((10, 12), 800, np.uint16), truth
    frame = thor2.RGBDFrame(*images, thor2.Intrinsics(50.0, 50.0, 5.0, 5.0))
    item = LabelledFrame("a", frame, {1: "can", 2: "pen_red", 3: "mug"}, {})

    rows, on_background = segmentation.compare(pieces, item)
    columns = [(row["iou"], row["piece"], row["over"], row["under"]) for row in rows]
    assert columns == [(1.0, 1, False, False), (0.5, 2, True, False), (0.5, 4, False, True)] and on_background == 1
    rows, on_background = segmentation.compare(np.zeros_like(pieces), item)
    assert [row["iou"] for row in rows] == [0.0, 0.0, 0.0] and on_background == 0

    report = segmentation.measure([item], lambda frame: pieces, None)
    assert (report["instances"], report["thick"], report["thick found"]) == (3, 2, 0.5)
    assert [report[name] for name in ("found", "over-segmented", "under-segmented")] == pytest.approx([1 / 3] * 3)


def test_bad_arguments_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for benchmark, arguments, message in (
        (cameras, "", "give --model, --frames and --out"),
        (cameras, "--model x", "give --model, --frames and --out"),
        (cameras, "--model x --frames y --out z", "y"),
        (levers, "--meshes . --frames . --out out --levers none", "none"),
        (levers, "--meshes . --frames . --out out --seeds 0", "seeds"),
        (levers, "--meshes absent --frames . --out out", "absent"),
        (paper, "--meshes . --out out", "scenes and frames are missing"),
        (paper, "--meshes . --out out --frames absent --folds 0", "folds is 0"),
        (paper, "--meshes . --out out --frames absent", "absent"),
        (paper, "--meshes . --out out --frames . --baselines tree", "baselines is tree"),
    ):
        monkeypatch.setattr(sys, "argv", ["benchmark", *arguments.split()])
        with pytest.raises(SystemExit) as caught:
            benchmark.main()
        error = capsys.readouterr().err if isinstance(caught.value.code, int) else f"error: {caught.value.code}"
        assert "error: " in error.splitlines()[-1] and message in error.splitlines()[-1], arguments
        assert list(tmp_path.iterdir()) == []


def test_the_service_accepts_the_host_of_the_load_test() -> None:
    head = multipart_request({"color": b"", "depth": b""}).split(b"\r\n\r\n")[0].decode()
    fields = dict(line.split(": ") for line in head.split("\r\n")[1:])
    assert is_allowed_host(fields["Host"], "127.0.0.1", ())


SAMPLES = Path(thor2.__file__).parent / "service" / "page" / "samples"


@pytest.mark.slow
def test_damaged_set_ups_are_diagnosed() -> None:
    """A toy recognizer is the less sure the more the colours differ from those of the sample."""
    color = frame_files(SAMPLES / "clutter").read().color.astype(float)

    def recognize(frame: thor2.RGBDFrame) -> list[thor2.Recognition]:
        confidence = float(np.exp(-20 * np.abs(frame.color - color).mean() / 255))
        return [thor2.Recognition(label, "known", confidence) for label in frame.instances]

    assert len(DAMAGES) == 20
    recognizer: Any = SimpleNamespace(recognize=recognize, classes=("known",))
    report = run(SAMPLES, recognizer, ["clutter"])
    wrong = {name: entry["found"] for name, entry in report["damaged"].items() if not entry["right"]}
    assert report["right_by_frame"]["clutter"] == 20 - len(wrong) and len(wrong) <= 2, wrong


CLASSES = ("bowl", "can", "mug")


def test_groups_are_directories_of_frames(tmp_path: Path) -> None:
    for k in range(2):
        write_frame_files(tmp_path / "video" / f"{k}", small_frame(), {1: "mug", 4: "banana"})
        write_frame_files(tmp_path / "hots" / f"mix_{k}", small_frame(), {1: "pen_red", 4: "book"})
    given = [tmp_path / "video", tmp_path / "hots" / "mix_1", tmp_path / "hots" / "mix_0"]
    frames = cameras.labelled_frames(given, cameras.LOOK_ALIKES)
    assert [item.identifier for item in frames] == ["video/0", "video/1", "hots/mix_1", "hots/mix_0"]
    assert [item.truth for item in frames] == [{1: "mug"}] * 2 + [{4: "book"}] * 2
    assert_refused("video/1", cameras.labelled_frames, [tmp_path / "video", tmp_path / "video" / "1"])


def test_metrics_match_hand_calculation() -> None:
    """A mug in a video of three frames, a can, a dragon; under the camera, one answer is lost and one is new."""

    def frames(mug: list[str | None], can: str, dragon: float) -> list[FrameAnswers]:
        video = [FrameAnswers(f"v/{k}", {}, 1.0, [toy_answer("mug", name, 0.7)]) for k, name in enumerate(mug)]
        can_frame = FrameAnswers("w/0", {}, 1.0, [toy_answer("can", can, 0.9)])
        return [*video, can_frame, FrameAnswers("u/0", {}, 1.0, [toy_answer("dragon", "can", dragon)])]

    answers = {
        "original": frames(["mug", "mug", "bowl"], "can", 0.8),
        "a": frames(["mug", None, "mug"], "can", 0.6),
        "b": frames(["can", "bowl", "bowl"], "mug", 0.65),
    }
    results = cameras.summarize(cameras.measure([ToyRun("x")], answers))
    assert list(results) == ["original", "a", "b", "all cameras"]

    def mean(name: str, metric: str) -> float:
        return results[name][metric]["mean"]

    assert [mean(name, "accuracy") for name in results] == pytest.approx([(2 / 3 + 1) / 2, (2 / 3 + 1) / 2, 0, 5 / 12])
    assert [mean(name, "accuracy_of_instances") for name in results] == pytest.approx([3 / 4, 3 / 4, 0, 3 / 8])
    assert [mean(name, "steadiness") for name in results] == pytest.approx([2 / 3] * 4)
    assert mean("original", "auroc") == pytest.approx(1 / 4) and mean("a", "auroc") == 1
    assert mean("all cameras", "auroc") == 1 and mean("original", "unknown_named") == 1
    assert mean("a", "unknown_named") == 0 and mean("b", "unknown_named") is None
    assert mean("original", "calibration_error") == pytest.approx((3 * abs(2 / 3 - 0.7) + 0.1) / 4, abs=1e-6)
    assert mean("a", "accuracy in v") == pytest.approx(2 / 3) and mean("a", "accuracy in w") == 1
    assert [mean(name, "placements") for name in results] == [2, 2, 2, 4]
    assert mean("all cameras", "unknown_instances") == 2
    assert results["a"]["threshold"]["runs"] == results["a"]["kept_at_threshold"]["runs"] == 0
    (of_run,) = cameras.measure([ToyRun("x", thresholds=np.full(3, 0.75))], answers)
    assert of_run["original"]["kept_at_threshold"] == pytest.approx(1 / 3)
    assert [of_run[name]["unknown_named_at_threshold"] for name in ("original", "a")] == [1, 0]
    table = cameras.show(results).splitlines()
    assert table[1].split()[:2] == ["original", "0.833"] and table[3].split()[-1] == "-"


def test_several_runs_have_a_deviation() -> None:
    """The second run answers "can" to the mug."""
    rows = np.array([[0.1, 0.2, 0.7], [0.1, 0.7, 0.2]], np.float32)
    frame = FrameAnswers("v/0", {}, 1.0, [InstancePrediction(1, "mug", probabilities=rows)])
    results = cameras.summarize(cameras.measure([ToyRun("x"), ToyRun("y")], {"original": [frame]}))
    assert results["original"]["accuracy"] == {"mean": 0.5, "std": pytest.approx(np.sqrt(0.5)), "runs": 2}
    assert results["original"]["steadiness"]["runs"] == 0
    assert "0.500 +- 0.707" in cameras.show(results)
    assert_refused("TOPS2", cameras.measure, [ToyRun("x"), ToyRun("y")], {"original": [frame]}, "TOPS2")
    assert_refused("frames", cameras.measure, [ToyRun("x")], {"original": [FrameAnswers("f", {}, 1.0, [])]})


@pytest.mark.slow
def test_the_command_of_the_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(2):
        write_frame_files(tmp_path / "video" / f"{k}", small_frame(k), {1: "mug", 4: "dragon"})
    for seed in range(2):
        save_run(untrained_run(CLASSES, ("tops",), seed=seed), tmp_path / f"run{seed}")
    out, picture = tmp_path / "out.json", tmp_path / "cameras.jpg"
    arguments = f"--model {tmp_path}/run0 {tmp_path}/run1 --frames {tmp_path}/video --out {out} --picture {picture}"
    monkeypatch.setattr(sys, "argv", ["cameras", *arguments.split()])
    cameras.main()
    report = json.loads(out.read_text())
    results = report["results"]
    assert list(results) == ["original", *(camera.name for camera in CHOOSE), "all cameras"]
    assert report["runs"] == ["run0", "run1"] and results["original"]["accuracy"]["runs"] == 2
    for metric, counts in (("instances", (2, 20)), ("placements", (1, 10))):
        assert tuple(results[name][metric]["mean"] for name in ("original", "all cameras")) == counts
    assert picture.read_bytes()[:3] == b"\xff\xd8\xff" and "worn: 2 frames" in capsys.readouterr().out
