"""Frames without labels: the service segments them, and says what is wrong with a segmenter."""

from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from processes import HANG
from refusals import assert_refused

import thor2_jax as thor2
from thor2_jax.client import Client
from thor2_jax.config import DescriptorConfig
from thor2_jax.segmentation.table import segment_table
from thor2_jax.service import preparation
from thor2_jax.service.problem import RequestError
from thor2_jax.service.settings import Settings

from .conftest import Files


def failing(frame: thor2.RGBDFrame) -> np.ndarray:
    raise RuntimeError("no weights\nin this folder")


def leaving(frame: thor2.RGBDFrame) -> np.ndarray:
    raise SystemExit(3)


def many(frame: thor2.RGBDFrame) -> np.ndarray:
    return np.arange(frame.depth.size).reshape(frame.depth.shape)


def test_a_frame_without_labels_is_segmented(
    server: Any, http: httpx.Client, scene: thor2.RGBDFrame, unlabelled: Files
) -> None:
    client = Client(server.url, timeout=HANG)
    recognitions, labels = client.recognize_frame(**unlabelled)
    np.testing.assert_array_equal(labels, segment_table(scene))
    assert [r.label for r in recognitions] == [1, 2, 3]
    assert [r.points_used > 100 for r in recognitions] == [True] * 3
    again, none = client.recognize_frame(**unlabelled, labels=labels)
    assert none is None
    assert [(r.name, r.confidence) for r in again] == [(r.name, r.confidence) for r in recognitions]
    answer = http.post("/v1/recognize", files=unlabelled).json()
    assert answer["label_map"]["width"] == 320 and answer["timings"]["segment"] > 0
    explained = http.post("/v1/explain", files=unlabelled).json()
    assert len(explained["instances"]) == 3 and set(explained["label_map"]["labels"]) == {0, 1, 2, 3}
    assert http.get("/v1/model").json()["segmenter"] == "table"


@pytest.mark.parametrize(
    ("segmenter", "status", "words"),
    [
        (failing, 500, "segmenter failing failed .*RuntimeError: no weights in this folder"),
        (leaving, 500, "segmenter leaving failed .*SystemExit: 3"),
        (many, 422, "labels has 76799 instances"),
        (None, 422, "labels is missing"),
    ],
)
def test_without_labels_of_a_segmenter_the_request_fails(
    unlabelled: Files, segmenter: Any, status: int, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(preparation, "_segmenter", lambda name: segmenter)
    with pytest.raises(RequestError, match=words) as caught:
        preparation.prepare_frame(unlabelled, DescriptorConfig(), False, segmenter and "chosen")
    assert (caught.value.status, caught.value.field) == (status, "labels")


def test_a_segmenter_that_cannot_be_loaded_stops_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings(tmp_path).segmenter == "table"
    assert_refused("segmenter is 'sam'; expected one of table", Settings, tmp_path, segmenter="sam")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert Settings(tmp_path).segmenter is None
