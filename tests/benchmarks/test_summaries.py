"""Summaries of the benchmarks against values by hand, their bad arguments, and the benchmark of `thor2 doctor`."""

from pathlib import Path

import numpy as np
import pytest
from image_files import SAMPLES
from toy_recognizers import recognizer_that_prefers

import thor2_jax as thor2
from benchmarks import adaptation, cameras, explanation, levers, paper, segmentation
from benchmarks.doctor import DAMAGES, run
from benchmarks.run_service import multipart_request
from benchmarks.tracking import METHODS, VIEWS, summarize_scenes
from thor2_jax.explanation.attributions import Attributions
from thor2_jax.service.hosts import is_allowed_host
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
        monkeypatch.setattr("sys.argv", ["benchmark", *arguments.split()])
        with pytest.raises(SystemExit) as caught:
            benchmark.main()
        error = capsys.readouterr().err if isinstance(caught.value.code, int) else f"error: {caught.value.code}"
        assert "error: " in error.splitlines()[-1] and message in error.splitlines()[-1], arguments
        assert list(tmp_path.iterdir()) == []


def test_the_service_accepts_the_host_of_the_load_test() -> None:
    head = multipart_request({"color": b"", "depth": b""}).split(b"\r\n\r\n")[0].decode()
    fields = dict(line.split(": ") for line in head.split("\r\n")[1:])
    assert is_allowed_host(fields["Host"], "127.0.0.1", ())


@pytest.mark.slow
def test_damaged_set_ups_are_diagnosed() -> None:
    assert len(DAMAGES) == 20
    recognizer = recognizer_that_prefers(frame_files(SAMPLES / "clutter").read().color, sharpness=20.0)
    report = run(SAMPLES, recognizer, ["clutter"])
    wrong = {name: entry["found"] for name, entry in report["damaged"].items() if not entry["right"]}
    assert report["right_by_frame"]["clutter"] == 20 - len(wrong) and len(wrong) <= 2, wrong
