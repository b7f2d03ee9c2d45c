"""Files for the Rerun viewer, read back with its own reader, and bags on a full disk."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from failures import small_disk
from recording_files import table_frame
from refusals import assert_refused

from thor2_jax.model.recognition import Recognition, detections_of
from thor2_jax.recordings.detection_files import DetectionBag, MessageBag, RerunFile
from thor2_jax.segmentation.segmenters import segmented

ANSWERS = [Recognition(1, "mug", 0.9), Recognition(2, reason="unknown: 0.1", confidence=0.1)]


@pytest.fixture
def reader() -> Any:
    """Return the reader of the package rerun-sdk, which is too large for the tests' own environment."""
    return pytest.importorskip("rerun.chunk", reason="rerun-sdk with a reader is not installed (660 MB)").RrdReader


def read(reader: Any, path: Path) -> dict[str, dict[str, list[Any]]]:
    """Return entity -> column -> values."""
    columns: dict[str, dict[str, list[Any]]] = {}
    for chunk in reader(path).stream():
        for name, values in chunk.to_record_batch().to_pydict().items():
            columns.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(values)
    return columns


def test_frames_and_detections_are_read_back(reader: Any, tmp_path: Path) -> None:
    with RerunFile(tmp_path / "a.rrd") as file:
        for k in range(3):
            frame = segmented(table_frame(3 * k))
            file.write(frame, detections_of(frame, ANSWERS), name=f"frame {k}", stamp=1_700_000_000 * 10**9 + k)
    found = read(reader, tmp_path / "a.rrd")
    assert {"/camera", "/camera/color", "/camera/depth", "/camera/labels", "/camera/boxes", "/objects"} <= set(found)
    boxes = found["/camera/boxes"]
    assert boxes["frame"] == [0, 1, 2]
    assert [int(time.value) for time in boxes["time"]] == [1_700_000_000 * 10**9 + k for k in range(3)]
    assert boxes["Boxes2D:labels"] == [["mug 0.90", "unknown 0.10"]] * 3
    np.testing.assert_allclose(boxes["Boxes2D:centers"][2], [[91, 115], [221, 115]], atol=2)
    np.testing.assert_allclose(np.array(found["/objects"]["Points3D:positions"])[..., 2], 0.8, atol=0.01)
    assert found["/camera/name"]["TextDocument:text"] == [["frame 0"], ["frame 1"], ["frame 2"]]
    assert [one.name for one in tmp_path.iterdir()] == ["a.rrd"]


def test_files_without_instances_or_frames(reader: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "new" / "a.rrd"
    with RerunFile(path):
        pass
    assert list(tmp_path.iterdir()) == []
    for count in (1, 2):  # A recording of this software is replaced.
        with RerunFile(path) as file:
            for _ in range(count):
                file.write(segmented(table_frame(), lambda frame: np.zeros(frame.depth.shape, int)), [], name="\udcff")
    assert read(reader, path)["/camera/name"]["frame"] == [0, 1]
    monkeypatch.setenv("RERUN", "off")
    assert_refused("RERUN", RerunFile, path)


def test_invalid_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    users = tmp_path / "a.rrd"
    users.write_bytes(b"RRF2 another program")
    assert_refused(r"rerun is .*a\.rrd", RerunFile, users)
    assert users.read_bytes() == b"RRF2 another program"
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert_refused(r"\.\[rerun\]", RerunFile, tmp_path / "b.rrd")


@pytest.mark.parametrize("size", [1000, 50_000])
def test_a_database_on_a_full_disk_is_named(tmp_path: Path, size: int) -> None:
    frame, path = segmented(table_frame()), tmp_path / "out"
    with small_disk(size), pytest.raises(OSError, match="disk") as caught, DetectionBag(path) as bag:
        for stamp in range(20):
            bag.write(frame, detections_of(frame, ANSWERS), stamp=stamp)
    assert caught.value.filename == str(path) and list(tmp_path.iterdir()) == []
    is_open = any(str(tmp_path) in os.path.realpath(file) for file in Path("/proc/self/fd").iterdir())
    assert not is_open or size == 1000  # rosbags leaves a database open if it cannot create its tables


def test_a_database_that_lost_its_messages_is_not_kept(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="full"), MessageBag(tmp_path / "out", {"/name": "std_msgs/msg/String"}) as bag:
        bag._writer.storage.conn.execute("PRAGMA max_page_count = 30")
        for stamp in range(100):
            bag.write_message("/name", {"data": "robot" * 1000}, stamp)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_noticed_before_rerun_waits_for_it(reader: Any, tmp_path: Path) -> None:
    with small_disk(500):
        assert_refused(f"rerun: {tmp_path / 'a.rrd'} .*large", RerunFile, tmp_path / "a.rrd")
    assert list(tmp_path.iterdir()) == []
