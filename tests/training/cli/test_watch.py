"""`thor2 watch`; the run's weights are random."""

import dataclasses
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import Command, Texts, run_thor2
from image_files import write_frame_files
from recording_files import table_frame, write_recording

from thor2_jax.segmentation.table import segment_table

FRAMES = [table_frame(shift) for shift in (0, 3, 6)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames without labels and one that is damaged."""
    for k, frame in enumerate(FRAMES):
        write_frame_files(tmp_path / "frames" / f"{k}", frame)
    (tmp_path / "frames" / "2" / "depth.png").write_bytes(b"damaged")
    return tmp_path / "frames"


def test_a_folder(model: Path, folder: Path, messages: list[dict[str, Any]], texts: Texts) -> None:
    _, err = texts("watch", "--model", model, "--folder", folder, "--port", 0)
    assert "watch at http://127.0.0.1:" in err and "2 of 3 were recognized (first error: 2: depth" in err
    assert f"thor2 recognize {folder} --segment table --model {model} --track --out answers" in err
    assert [one["state"] for one in messages] == ["waiting", "live", "live", "live", "ended"]
    assert [one.get("frame") for one in messages] == [None, "0", "1", "2", "2"]
    assert [len(one["objects"]) for one in messages[1:4]] == [2, 2, 0] and "depth" in messages[3]["error"]
    assert messages[-1]["number"] == 2


def test_only_frames_without_labels_need_opencv(
    model: Path, tmp_path: Path, messages: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, refused: Command
) -> None:
    write_frame_files(tmp_path / "frames" / "0", dataclasses.replace(FRAMES[0], labels=segment_table(FRAMES[0])))
    monkeypatch.delitem(sys.modules, "thor2_jax.segmentation.table")
    monkeypatch.setitem(sys.modules, "cv2", None)
    command = "watch", "--model", model, "--folder", tmp_path / "frames", "--port", 0
    assert run_thor2(*command) == 0
    assert messages[-1]["number"] == 1
    assert "needs OpenCV" in refused(*command, "--segment", "table")
    (tmp_path / "frames" / "0" / "mask.png").unlink()
    assert "needs OpenCV" in refused(*command)


def test_ctrl_c(model: Path, folder: Path, messages: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thor2_jax.watch.live.LiveView.show", lambda *_: signal.raise_signal(signal.SIGINT))
    handler = signal.getsignal(signal.SIGINT)
    assert run_thor2("watch", "--model", model, "--folder", folder, "--port", 0) == 0
    assert [one["state"] for one in messages] == ["waiting"]
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_damaged_recording_ends_with_its_line(
    model: Path, tmp_path: Path, messages: list[dict[str, Any]], texts: Texts, refused: Command
) -> None:
    path = write_recording(tmp_path / "a.mcap", FRAMES, gap=5 * 10**9)
    error = texts("watch", "--model", model, "--bag", path, "--port", 0, status=2)[1].splitlines()[-1]
    assert error.startswith("error: --bag: ") and "expected at most" in error
    assert messages[-1]["state"] == "failed" and "expected at most" in messages[-1]["message"]
    path.write_bytes(path.read_bytes()[:1000])
    assert "mcap recover" in refused("watch", "--model", model, "--bag", path, "--port", 0)


def test_invalid_arguments(model: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    frame = write_frame_files(tmp_path / "frame", FRAMES[0])
    for arguments, expected in (
        ("", "sources given: none"),
        ("--bag a.bag --realsense", "sources given: --bag, --realsense"),
        ("--folder a --color-topic /c", "--color-topic is /c; it belongs to --bag"),
        ("--folder absent", "not a directory"),
        ("--bag absent", "No such file"),
        ("--folder a --segment sam", "error: --segment is 'sam'"),
        (f"--folder {frame} --answer-by gallery", "--answer-by is gallery"),
        (f"--folder {frame} --unknown-below 2", "--unknown-below is 2"),
    ):
        assert expected in refused("watch", "--model", model, *arguments.split())
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    assert "error: --realsense needs pyrealsense2" in refused("watch", "--model", model, "--realsense")
