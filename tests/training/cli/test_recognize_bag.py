"""`thor2 recognize --bag`, end to end; the run's weights are random."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, Recognize, Texts, json_lines, run_thor2
from image_files import write_frame_files
from PIL import Image
from recording_files import COLOR, PERIOD, START, bag_writer, image, table_frame, write_images, write_recording
from rosbags.highlevel import AnyReader

FRAMES = [table_frame(shift) for shift in (0, 3, 6)]


def messages_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return topic -> (time, message) of a recording, read with the definitions that it holds."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, time, content in reader.messages():
            messages.setdefault(connection.topic, []).append((time, reader.deserialize(content, connection.msgtype)))
    return messages


@pytest.mark.parametrize(
    ("name", "out"),
    [pytest.param("a.bag", "out.mcap", marks=pytest.mark.slow), ("folder", "out"), ("a.mcap", "out.mcap")],
)
def test_detections_are_read_back(recognize: Recognize, tmp_path: Path, name: str, out: str) -> None:
    """The objects of the folder are tracked."""
    is_tracked, path = name == "folder", write_recording(tmp_path / name, FRAMES, is_compressed=name == "a.mcap")
    lines = recognize("--bag", path, "--out-bag", tmp_path / out, *["--track"] * is_tracked)
    assert [line["frame"] for line in lines] == [f"1700000000.{k * PERIOD:09d}" for k in range(3)]
    messages = messages_of(tmp_path / out)
    assert set(messages) == {"/thor2/detections", "/thor2/overlay/compressed"}
    for k, (line, (time, array)) in enumerate(zip(lines, messages["/thor2/detections"], strict=True)):
        assert time == START + k * PERIOD == array.header.stamp.sec * 10**9 + array.header.stamp.nanosec
        assert array.header.frame_id == "camera_color_optical_frame"
        for one, detection in zip(line["instances"], array.detections, strict=True):
            (result,) = detection.results
            assert result.hypothesis.class_id == one["name"] and result.hypothesis.score == one["confidence"]
            position = result.pose.pose.position
            assert [position.x, position.y, position.z] == one["position"]
            box = detection.bbox
            corner = box.center.position.x - (box.size_x - 1) / 2, box.center.position.y - (box.size_y - 1) / 2
            assert [*corner, box.size_x, box.size_y] == one["box"]
        assert [detection.id for detection in array.detections] == ["1", "2"]
        expected = [[60 + 3 * k, 80, 50, 70], [180 + 3 * k, 80, 70, 70]]
        np.testing.assert_allclose([one["box"] for one in line["instances"]], expected, atol=2)
        assert line["instances"][0]["position"][2] == pytest.approx(0.8, abs=0.01)
        tracks = [(one.get("track"), one.get("frames")) for one in line["instances"]]
        assert tracks == ([(1, k + 1), (2, k + 1)] if is_tracked else [(None, None)] * 2)
    _, overlay = messages["/thor2/overlay/compressed"][0]
    assert Image.open(io.BytesIO(overlay.data.tobytes())).size == (320, 240)
    assert not [one for one in tmp_path.iterdir() if one.name.startswith(".")]


@pytest.mark.parametrize("segment", [(), pytest.param(("--segment", "model"), marks=pytest.mark.slow)])
def test_every_second_frame_and_pictures(recognize: Recognize, segment: tuple[str, ...], tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap", FRAMES)
    lines = recognize("--bag", path, "--every", 2, "--out", tmp_path / "out", "--unknown-below", 1, *segment)
    assert [line["frame"] for line in lines] == ["1700000000.000000000", "1700000000.066666666"]
    assert all(one["name"] is None for line in lines for one in line["instances"])
    assert sorted(one.name for one in (tmp_path / "out").iterdir()) == [line["frame"] for line in lines]


def test_rerun_files_of_bags_and_folders(model: Path, tmp_path: Path, printed: Command) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (pip install rerun-sdk; 660 MB)")
    path = write_recording(tmp_path / "a.mcap", FRAMES)
    assert run_thor2("recognize", "--model", model, "--bag", path, "--rerun", tmp_path / "bag.rrd") == 0
    write_frame_files(tmp_path / "frames" / "0", FRAMES[0])
    command = ("recognize", "--model", model, tmp_path / "frames", "--segment", "table")
    assert f"written to {tmp_path / 'folder.rrd'}" in printed(*command, "--rerun", tmp_path / "folder.rrd")
    for name in ("bag.rrd", "folder.rrd"):
        assert (tmp_path / name).read_bytes().startswith(b"RRF2")


def test_a_failing_frame_stops_no_other(model: Path, tmp_path: Path, texts: Texts) -> None:
    path = tmp_path / "a.mcap"
    with bag_writer(path) as write:
        for k, pixels in enumerate((FRAMES[0].color, FRAMES[0].color[:100], FRAMES[0].color)):
            write(COLOR, image(pixels, "rgb8", START + k * PERIOD), START + k * PERIOD)
            write("/depth", image(FRAMES[0].depth, "16UC1", START + k * PERIOD), START + k * PERIOD)
    (tmp_path / "K.txt").write_text("290 0 160 0 290 120 0 0 1")
    command = ("recognize", "--model", model, "--bag", path, "--intrinsics", tmp_path / "K.txt")
    out, err = texts(*command, "--out-bag", tmp_path / "out.mcap", status=2)
    assert ["error" in line for line in json_lines(out)] == [False, True, False]
    assert err.splitlines()[-1].startswith("error: 1 of 3 frames") and "failed: 1700000000.033333333" in err
    assert len(messages_of(tmp_path / "out.mcap")["/thor2/detections"]) == 2


def test_what_was_done_before_the_end_is_kept(model: Path, tmp_path: Path, texts: Texts) -> None:
    path = write_recording(tmp_path / "a.mcap", [table_frame(k) for k in range(8)])
    path.write_bytes(path.read_bytes()[: -(10**6)])
    out, err = texts("recognize", "--model", model, "--bag", path, "--out-bag", tmp_path / "out.mcap", status=2)
    n_frames = len(json_lines(out))
    assert 0 < n_frames < 8 and "mcap recover" in err and err.count("\n") == 1
    assert f"frames recognized before: {n_frames}, written to {tmp_path / 'out.mcap'}" in err
    assert len(messages_of(tmp_path / "out.mcap")["/thor2/detections"]) == n_frames


def test_frames_with_one_stamp_and_before_1970(recognize: Recognize, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with bag_writer(path) as write:
        for arrival, stamp in enumerate((-1, START, START, START)):
            write_images(write, FRAMES[0], arrival, stamp)
    lines = recognize("--bag", path, "--out", tmp_path / "out", "--out-bag", tmp_path / "out.mcap")
    names = [line["frame"] for line in lines]
    assert names == ["-0.000000001", *(f"1700000000.000000000{end}" for end in ("", "-2", "-3"))]
    assert sorted(one.name for one in (tmp_path / "out").iterdir()) == sorted(names)
    messages = messages_of(tmp_path / "out.mcap")["/thor2/detections"]
    assert [time for time, _ in messages] == [0, START, START, START]
    assert (messages[0][1].header.stamp.sec, messages[0][1].header.stamp.nanosec) == (-1, 10**9 - 1)


def test_texts_of_recordings_are_escaped(model: Path, tmp_path: Path, texts: Texts) -> None:
    path = tmp_path / "a.mcap"
    with bag_writer(path) as write:
        write_images(write, FRAMES[0], frame_id="a\n\x1b[2J")
    _, err = texts("recognize", "--model", model, "--bag", path)
    (note,) = [line for line in err.splitlines() if line.startswith("note: ")]
    assert r"color in a\n\x1b[2J" in note


def test_a_time_out_of_the_range_of_ros_2(model: Path, tmp_path: Path, refused: Command) -> None:
    path, late = tmp_path / "a.mcap", 2**31 * 10**9
    with bag_writer(path) as write:  # images without a time stamp have the time at which they were recorded
        write_images(write, FRAMES[0], late, 0)
    error = refused("recognize", "--model", model, "--bag", path, "--out-bag", tmp_path / "out.mcap", at_once=False)
    assert "error: --out-bag: a frame has the time 2147483648 s" in error
    assert str(tmp_path / "out.mcap") not in error and not (tmp_path / "out.mcap").exists()


def test_invalid_arguments(model: Path, tmp_path: Path, refused: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_recording(Path("in.mcap"), FRAMES[:1])
    before = sorted(tmp_path.iterdir())
    for arguments, expected in (
        ("--coco c.json", "coco is c.json and --bag is"),
        ("--workers 2", "workers is 2 and --bag is"),
        ("--out-bag a.bag", "expected an MCAP file"),
        ("--out-bag .", "which exists"),
        ("--out-bag none/a.mcap", "No such file"),
        ("--color-topic /x", "--color-topic is /x"),
        ("--max-gap 0", "--max-gap is 0"),
        ("--max-gap 1e300", "--max-gap is 1e+300"),
        ("--every 99999999999999999999", "'--every'"),
        ("--out-bag in.mcap/a.mcap", "a.mcap: Not a directory"),
        ("--depth-scale 0", "error: --depth-scale is 0"),
        ("--max-gap 0.001 --out-bag out", "expected at most 0.001 s"),
        ("--rerun a.mcap", "the suffix .rrd"),
    ):
        assert expected in refused("recognize", "--model", model, "--bag", path, *arguments.split()), arguments
        assert sorted(tmp_path.iterdir()) == before
