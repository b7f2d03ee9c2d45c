"""Recordings of ROS 1, ROS 2 and MCAP."""

import os
import re
import sqlite3
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import recording_files as files
from recording_files import COLOR, START, bag_writer, image, table_frame, write_recording
from refusals import assert_refused

import thor2_jax as thor2
from thor2_jax.frames.frames import RecordedFrame
from thor2_jax.recordings import bags
from thor2_jax.recordings.bags import Bag
from thor2_jax.recordings.detection_files import DetectionBag, MessageBag, RerunFile
from thor2_jax.recordings.topics import Topics

FRAMES = [table_frame(shift) for shift in (0, 3, 6)]
NAMES = ("a.bag", "folder", "a.mcap")


def frames_of(path: Path, **options: Any) -> list[RecordedFrame]:
    with Bag(path, **options) as bag:
        return list(bag.frames())


@pytest.mark.parametrize("is_compressed", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_frames_of_recordings(tmp_path: Path, name: str, is_compressed: bool) -> None:
    path = write_recording(tmp_path / name, FRAMES, is_compressed=is_compressed)
    with Bag(path) as bag:
        recorded = list(bag.frames())
        assert bag.notes == [] and bag.frame_id == "camera_color_optical_frame"
    assert [one.name for one in recorded] == ["1700000000.000000000", "1700000000.033333333", "1700000000.066666666"]
    assert all(one.gap == 4_000_000 for one in recorded)
    for one, expected in zip(recorded, FRAMES, strict=True):
        frame = one.read()
        assert frame.labels is None and frame.intrinsics.fx == 290 and frame.intrinsics.width == 320
        np.testing.assert_array_equal(frame.depth, expected.depth)
        difference = np.abs(frame.color.astype(int) - expected.color)
        assert difference.mean() < 2 if is_compressed else difference.max() == 0
    if path.is_dir():
        assert len(frames_of(next(path.glob("*.db3")))) == 3
        for suffix in (".bag", ".mcap"):
            assert len(frames_of(path := path.rename(tmp_path / f"run{suffix}"))) == 3


def test_the_file_of_intrinsics_replaces_the_topic(tmp_path: Path) -> None:
    path = write_messages(tmp_path / "a.mcap", {COLOR: image(RGB, "rgb8"), files.DEPTH: image(DEPTH, "16UC1")})
    assert_refused("camera_topic", Bag(path).__enter__)
    assert_refused("is not open", list, Bag(path).frames())
    with Bag(path, intrinsics=thor2.Intrinsics(300, 300, 160, 120)) as closed:
        pass
    assert_refused("is not open", list, closed.frames())
    (recorded,) = frames_of(path, intrinsics=thor2.Intrinsics(300, 300, 160, 120), depth_scale=5000)
    assert recorded.read().intrinsics == thor2.Intrinsics(300, 300, 160, 120, 5000)


def write_messages(path: Path, messages: dict[str, Any]) -> Path:
    """Write one message for each topic."""
    with bag_writer(path) as write:
        for topic, message in messages.items():
            write(topic, message, START)
    return path


INFO, RGB, DEPTH = files.camera_info(FRAMES[0].intrinsics, (240, 320)), FRAMES[0].color, FRAMES[0].depth


def test_rectified_images_have_the_camera_of_the_projection(tmp_path: Path) -> None:
    info = files.camera_info(FRAMES[0].intrinsics, (240, 320))
    info.d[:] = 0.1, 0, 0, 0, 0
    info.p[0] = 280.0
    images = {f"/cam/image_{kind}": image(RGB, "bgr8") for kind in ("rect_color", "raw")}
    depth = {"/cam/depth_registered/image": image(DEPTH, "16UC1")}
    path = write_messages(tmp_path / "a.mcap", images | depth | {"/cam/camera_info": info})
    for topic, fx, distortion in (("/cam/image_rect_color", 280, ()), ("cam/image_raw", 290, (0.1, 0, 0, 0, 0))):
        with Bag(path, Topics(color=topic)) as bag:
            assert bag.intrinsics is not None and (bag.intrinsics.fx, bag.intrinsics.distortion) == (fx, distortion)
    assert_refused("color_topic is not given", Bag(path).__enter__)


def test_depth_that_is_not_aligned_and_another_camera(tmp_path: Path) -> None:
    depth = image(DEPTH[::2, ::2], "16UC1", frame_id="depth")
    messages = {COLOR: image(RGB, "rgb8", frame_id="rgb"), files.CAMERA: INFO, "/camera/depth/image_rect_raw": depth}
    with Bag(write_messages(tmp_path / "a.mcap", messages)) as bag:
        assert ["aligned" in note for note in bag.notes] == [True, False] and files.CAMERA in bag.notes[1]
        (recorded,) = bag.frames()
        assert_refused("160 x 120 pixels and color 320 x 240", recorded.read)


def test_messages_describe_the_content_of_topics(tmp_path: Path) -> None:
    write_messages(tmp_path / "a.mcap", {COLOR: image(RGB[..., 0], "mono8")})
    assert_refused(rf"{COLOR} \(sensor_msgs/msg/Image, 'mono8'\)", Bag(tmp_path / "a.mcap").__enter__)
    with MessageBag(tmp_path / "b.mcap", {COLOR: "sensor_msgs/msg/Image", "/name": "std_msgs/msg/String"}) as bag:
        bag.write_message("/name", {"data": "robot"}, START)
    for topic, content in ((COLOR, "sensor_msgs/msg/Image without messages"), ("/name", "std_msgs/msg/String")):
        assert_refused(f"holds {content}; expected 8-bit", Bag(tmp_path / "b.mcap", Topics(topic)).__enter__)


def test_streams_out_of_step(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.bag", FRAMES, gap=5 * 10**9)
    assert_refused(r"at least 4\.93 s apart", frames_of, path)
    assert len(frames_of(path, max_gap=6)) == 3


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kept", [0, 0.001, 0.3, 0.9, 1])
def test_damaged_recordings(tmp_path: Path, name: str, kept: float) -> None:
    path = write_recording(tmp_path / name, FRAMES)
    file = next(path.glob("*.db3")) if path.is_dir() else path
    content = bytearray(file.read_bytes())
    if kept == 1:  # bytes in the middle
        content[len(content) // 3 : len(content) // 3 + 2000] = bytes(2000)
    file.write_bytes(content[: int(kept * len(content))])
    try:
        for recorded in frames_of(path):
            recorded.read()
    except thor2.InputError as error:
        assert str(path) in str(error)
    else:
        assert kept == 1, "a truncated recording was read without an error"


def test_a_truncated_file_may_have_messages_in_any_order(tmp_path: Path) -> None:
    with bag_writer(tmp_path / "a.mcap") as write:
        for number in range(9):  # depth is recorded first, and written last
            files.write_images(write, FRAMES[0], START + number * files.PERIOD, START + number * files.PERIOD, gap=-1)
    content = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(content[: 3 * len(content) // 4])
    with Bag(tmp_path / "a.mcap") as bag:
        assert_refused("is truncated", list, bag.frames())
        assert 4 < bag.counts.pairs < 9


def test_chunks_without_an_index_of_their_messages_are_read(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap", FRAMES)
    content = bytearray(path.read_bytes())
    place = int.from_bytes(content[-28:-20], "little")  # of the summary
    while content[place] != 0x02:
        end = place + 9 + int.from_bytes(content[place + 1 : place + 9], "little")
        if content[place] == 0x08:  # the place of the index of each channel moves behind the fields that are read
            length, rest = int.from_bytes(content[place + 41 : place + 45], "little"), place + 45
            index = content[rest : rest + length]
            content[place + 41 : end] = bytes(4) + content[rest + length : end] + index
        place = end
    path.write_bytes(content)
    assert len(frames_of(path)) == 3


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap", "folder/folder.db3", "folder/other"])
def test_pipes_are_refused(tmp_path: Path, name: str) -> None:
    write_recording(tmp_path / "folder", FRAMES[:1])
    (tmp_path / name).unlink(missing_ok=True)
    os.mkfifo(tmp_path / name)
    with pytest.raises(OSError, match="pipe"):
        Bag(tmp_path / name.partition("/")[0]).__enter__()


def test_messages_in_a_write_ahead_log_are_not_lost(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "folder", FRAMES[:1])
    (path / "folder.db3-wal").write_bytes(b"messages")
    for recording in (path, path / "folder.db3"):
        assert_refused(r"sqlite3 .*folder\.db3 'PRAGMA", Bag(recording).__enter__)


@pytest.mark.parametrize(
    ("name", "compression"),
    [("a.bag", "bz2"), ("a.bag", "lz4"), ("a.mcap", "storage"), ("folder", "message"), ("folder", "file")],
)
def test_decompression_is_limited(tmp_path: Path, name: str, compression: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_recording(tmp_path / name, FRAMES[:1], compression=compression)
    np.testing.assert_array_equal(frames_of(path)[0].read().depth, FRAMES[0].depth)
    monkeypatch.setattr(bags, "MAX_DECOMPRESSED", 2**16)
    monkeypatch.setattr(bags, "MAX_RATIO", 1)
    assert_refused("more than 65536 bytes", frames_of, path)


def test_the_largest_overlap_of_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for chunks, expected in (
        ([], 0),
        ([(0, 9, 5, 1), (5, 12, 5, 2), (10, 20, 5, 1), (13, 30, 5, 1)], 10),
        ([(0, 9, 5, 1), (5, 9, 5, 1), (9, 20, 5, 1)], 15),
        ([(0, 5, 7, 1), (9, 1, 50, 2), (3, 4, 1, 1), (0, 20, 100, 3)], 50),
    ):
        names = "message_start_time", "message_end_time", "uncompressed_size", "channel_count"
        made = [SimpleNamespace(**dict(zip(names, [*each, {k: 1}], strict=True))) for *each, k in chunks]
        reader = SimpleNamespace(storage=SimpleNamespace(chunks=made))
        assert bags._largest_overlap(reader, {1, 2}) == expected
    path = write_recording(tmp_path / "a.mcap", FRAMES[:1])
    monkeypatch.setattr(bags, "MAX_OVERLAPPING", 1000)
    assert_refused("chunks of the same time; expected at most 1000", Bag(path).__enter__)


MANY_ALIASES = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 8)}]" for k in range(1, 12)]


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        *((f"name: {COLOR}", f"name: {value}", "damaged") for value in ("[x]", "5", "*a11")),
        (r"(?s)  files:.*?(?=\n  \w)", "  files: x", "not a list"),
    ],
)
def test_damaged_metadata(tmp_path: Path, pattern: str, replacement: str, message: str) -> None:
    path = write_recording(tmp_path / "folder", FRAMES[:1])
    text, count = re.subn(pattern, replacement, (path / "metadata.yaml").read_text())
    assert count
    (path / "metadata.yaml").write_text("\n".join(["a0: &a0 [x]", *MANY_ALIASES, text]) if "*" in replacement else text)
    assert_refused(message, Bag(path).__enter__)


@pytest.mark.parametrize("name", NAMES)
def test_definitions_of_messages_are_not_compiled(tmp_path: Path, name: str) -> None:
    path = write_recording(tmp_path / name, FRAMES[:1])
    file = next(path.glob("*.db3")) if path.is_dir() else path
    content = file.read_bytes()
    assert b"uint32 height" in content
    file.write_bytes(content.replace(b"uint32 height", b"import height"))
    np.testing.assert_array_equal(frames_of(path)[0].read().depth, FRAMES[0].depth)


@pytest.mark.parametrize(
    "computed", ["timestamp AS ('x')", "timestamp AS (NULL)", "data AS ('x')", "data AS (zeroblob(1000000))"]
)
def test_columns_of_other_types_and_sizes(tmp_path: Path, computed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = "data" if computed.startswith("timestamp") else "timestamp"
    path = write_recording(tmp_path / "folder", FRAMES[:1])
    with sqlite3.connect(path / "folder.db3") as database:
        database.execute("ALTER TABLE messages RENAME TO old")
        database.execute(f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, {stored}, {computed})")
        database.execute(f"INSERT INTO messages(topic_id, {stored}) SELECT topic_id, {stored} FROM old")
    database.close()
    monkeypatch.setattr(bags, "MAX_DECOMPRESSED", 2**18)
    assert_refused("too big" if "zeroblob" in computed else "damaged", frames_of, path)


def test_no_recording_or_no_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x.bag").mkdir()
    message = "damaged or of another format.*metadata.yaml((?!repair).)*repair it: ros2 bag reindex .*/x.bag$"
    assert_refused(message, Bag(tmp_path / "x.bag").__enter__)
    for open_file, name in ((Bag, "bag"), (DetectionBag, "out_bag"), (RerunFile, "rerun")):
        assert_refused(f"^{name} is 'a.x00b'; expected a path", open_file, "a\0b")
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    assert_refused(r"\.\[bags\]", Bag(tmp_path).__enter__)
