"""The benchmark of segmentation: overlaps and counts by hand, and a report of a frame."""

import numpy as np
import pytest

from benchmarks.segmentation import compare, measure
from thor2_jax.frames.frames import RGBDFrame
from training.readers.labelled import LabelledFrame


def frame_of(truth: np.ndarray, names: dict[int, str]) -> LabelledFrame:
    color, depth = np.zeros((*truth.shape, 3), np.uint8), np.full(truth.shape, 800, np.uint16)
    camera = {"fx": 50.0, "fy": 50.0, "cx": 5.0, "cy": 5.0}
    return LabelledFrame("a", RGBDFrame(color, depth, truth, camera), names, {})  # type: ignore[arg-type]


def scene() -> tuple[LabelledFrame, np.ndarray]:
    """Return three instances of 20 pixels: exact, in two pieces, and in one piece with a fourth one."""
    truth, pieces = np.zeros((10, 12), np.uint8), np.zeros((10, 12), np.int32)
    truth[0:2, 0:10], truth[3:5, 0:10], truth[6:8, 0:10], truth[8:10, 0:10] = 1, 2, 3, 7
    pieces[0:2, 0:10] = 1
    pieces[3:5, 0:5], pieces[3:5, 5:10] = 2, 3
    pieces[6:10, 0:10] = 4
    pieces[0:10, 11] = 5
    return frame_of(truth, {1: "can", 2: "pen_red", 3: "mug"}), pieces


def test_overlaps_by_hand() -> None:
    item, pieces = scene()
    rows, on_background = compare(pieces, item)
    assert [row["iou"] for row in rows] == [1.0, 0.5, 0.5]
    assert [row["piece"] for row in rows] == [1, 2, 4]
    assert [row["over"] for row in rows] == [False, True, False]
    assert [row["under"] for row in rows] == [False, False, True]
    assert on_background == 1


def test_a_frame_without_pieces() -> None:
    item, pieces = scene()
    rows, on_background = compare(np.zeros_like(pieces), item)
    assert [row["iou"] for row in rows] == [0.0, 0.0, 0.0] and on_background == 0


def test_the_report_of_a_group() -> None:
    item, pieces = scene()
    report = measure([item], lambda frame: pieces, None)
    assert report["instances"] == 3 and report["thick"] == 2
    assert report["found"] == pytest.approx(1 / 3) and report["thick found"] == 0.5
    assert report["over-segmented"] == pytest.approx(1 / 3) and report["under-segmented"] == pytest.approx(1 / 3)
