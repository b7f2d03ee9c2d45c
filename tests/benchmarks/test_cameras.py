"""The benchmark of simulated cameras: its frames, its metrics by hand, and the command with an untrained run."""

import json
from pathlib import Path

import numpy as np
import pytest
from image_files import small_frame, write_frame_files
from refusals import assert_refused
from small_runs import save_untrained_run
from toy_recognizers import ToyRun, toy_answer

from benchmarks import cameras
from training.augmentation.simulated_cameras import CHOOSE
from training.evaluation.answers import FrameAnswers, InstancePrediction


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
def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(2):
        write_frame_files(tmp_path / "video" / f"{k}", small_frame(k), {1: "mug", 4: "dragon"})
    for seed in range(2):
        save_untrained_run(tmp_path / f"run{seed}", ("bowl", "can", "mug"), ("tops",), seed=seed)
    out, picture = tmp_path / "out.json", tmp_path / "cameras.jpg"
    arguments = f"--model {tmp_path}/run0 {tmp_path}/run1 --frames {tmp_path}/video --out {out} --picture {picture}"
    monkeypatch.setattr("sys.argv", ["cameras", *arguments.split()])
    cameras.main()
    report = json.loads(out.read_text())
    results = report["results"]
    assert list(results) == ["original", *(camera.name for camera in CHOOSE), "all cameras"]
    assert report["runs"] == ["run0", "run1"] and results["original"]["accuracy"]["runs"] == 2
    for metric, counts in (("instances", (2, 20)), ("placements", (1, 10))):
        assert tuple(results[name][metric]["mean"] for name in ("original", "all cameras")) == counts
    assert picture.read_bytes()[:3] == b"\xff\xd8\xff" and "worn: 2 frames" in capsys.readouterr().out
