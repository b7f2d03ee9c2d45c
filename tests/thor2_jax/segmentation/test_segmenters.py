"""Segmenters by name: the built-in one, entry points of other packages, and what they may do wrong."""

import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

import thor2_jax as thor2
from thor2_jax.segmentation import segmenters
from thor2_jax.segmentation.segmenters import ENTRY_POINTS, load_segmenter, segment, segmenter_names
from thor2_jax.segmentation.table import segment_table

FRAME = thor2.RGBDFrame(
    np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 800, np.uint16), np.ones((6, 8), np.uint8), np.eye(3) * [50, 50, 1]
)


def halves(frame: thor2.RGBDFrame) -> np.ndarray[Any, Any]:
    assert frame.labels is None
    labels = np.zeros(frame.depth.shape, np.uint16)
    labels[:, 4:] = 1
    return labels


@pytest.fixture
def offer(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Return a function that offers an entry point of the group for the duration of a test."""
    points: list[EntryPoint] = []
    monkeypatch.setattr(segmenters, "entry_points", lambda **wanted: EntryPoints(points).select(**wanted))
    monkeypatch.setitem(sys.modules, "wrapper", sys.modules[__name__])
    return lambda name, value: points.append(EntryPoint(name, value, ENTRY_POINTS))


def test_the_table_segmenter_is_built_in() -> None:
    assert segmenter_names()[0] == "table" and load_segmenter("table") is segment_table
    np.testing.assert_array_equal(thor2.segment(FRAME), segment_table(FRAME))
    assert_refused("^frame is of type str; expected an RGBDFrame", thor2.segmented, "frame.png")


def test_a_segmenter_of_another_package(offer: Callable[[str, str], None]) -> None:
    offer("halves", "wrapper:halves")
    assert segmenter_names() == ["table", "halves"]
    expected = halves(thor2.RGBDFrame(FRAME.color, FRAME.depth, None, FRAME.intrinsics))
    for segmenter in ("halves", halves):
        np.testing.assert_array_equal(segment(FRAME, segmenter), expected)
        np.testing.assert_array_equal(thor2.segmented(FRAME, segmenter).label_image, expected)
    assert FRAME.labels is not None and FRAME.labels.all()
    assert_refused(r"^segmenter is 'sam'; expected one of table, halves, .*" + ENTRY_POINTS, segment, FRAME, "sam")
    assert_refused("^segmenter is 'model', which only recognize and explain take", load_segmenter, "model")


@pytest.mark.parametrize("value", ["no_such_package_anywhere:f", "wrapper:no_such_function", "wrapper:FRAME"])
def test_an_entry_point_that_is_no_function(offer: Callable[[str, str], None], value: str) -> None:
    offer("broken", value)
    assert_refused(rf"^segmenter is 'broken'; {value} ", load_segmenter, "broken")


def test_the_table_segmenter_without_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(sys.modules):
        if name.startswith("thor2_jax.segmentation.") and "segmenters" not in name:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert_refused(r"^segmenter is 'table', which needs OpenCV .*\[segment\]", load_segmenter, "table")


def test_segmenters_that_fail() -> None:
    for result, message in (
        (None, "a value of type NoneType"),
        (np.zeros((6, 7), int), r"invalid labels: labels has shape \(6, 7\)"),
        (np.zeros((6, 8), bool), "invalid labels: labels has type bool"),
        (np.full((6, 8), -1), "invalid labels: labels has the value -1"),
    ):
        assert_refused(rf"^segmenter <lambda> returned {message}", segment, FRAME, lambda frame, result=result: result)

    def failing(frame: thor2.RGBDFrame) -> np.ndarray[Any, Any]:
        raise NotImplementedError  # without a message

    assert_refused("^frame is of type str", segment, FRAME, lambda frame: segment_table(segment("frame")))
    assert_refused(r"^segmenter failing failed .*\(NotImplementedError\);", segment, FRAME, failing)
