"""Frames without labels: the service segments them, and says what is wrong with a segmenter."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from processes import HANG

import thor2_jax as thor2
from thor2_jax.client import Client
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.segmentation.table import segment_table
from thor2_jax.service.preparation import PreparationPool, prepare_frame
from thor2_jax.service.problem import RequestError
from thor2_jax.service.settings import Settings

Files = dict[str, bytes]

WRAPPER = """
import numpy as np

def halves(frame):
    labels = np.zeros(frame.depth.shape, np.uint8)
    labels[:, frame.depth.shape[1] // 2:] = 7
    return labels

def failing(frame):
    raise RuntimeError("no weights\\nin this folder")

def leaving(frame):
    raise SystemExit(3)

def many(frame):
    return np.arange(frame.depth.size).reshape(frame.depth.shape)
"""


@pytest.fixture
def wrapper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package with segmenters."""
    (tmp_path / "wrapper_package.py").write_text(WRAPPER)
    record = tmp_path / "wrapper_package-1.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: wrapper-package\nVersion: 1\n")
    names = "".join(f"{name} = wrapper_package:{name}\n" for name in ("halves", "failing", "leaving", "many"))
    (record / "entry_points.txt").write_text(f"[thor2_jax.segmenters]\n{names}")
    monkeypatch.syspath_prepend(tmp_path)


@contextlib.contextmanager
def preparation_by(name: str | None) -> Iterator[Callable[[Files], Any]]:
    """Yield a function that prepares a frame in the process of a pool with a segmenter."""
    with contextlib.closing(PreparationPool(1, name)) as pool:
        yield lambda files: pool.submit(
            time.monotonic() + HANG, prepare_frame, files, DescriptorConfig(), False, name
        ).result(HANG)


def test_a_frame_without_labels_is_segmented(
    server: Any, http: httpx.Client, scene: thor2.RGBDFrame, unlabelled: Files
) -> None:
    client = Client(server.url)
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


@pytest.mark.usefixtures("wrapper")
def test_a_segmenter_of_another_package(unlabelled: Files) -> None:
    with preparation_by("halves") as prepare:
        prepared = prepare(unlabelled)
    assert [instance.label for instance in prepared.instances] == [7]
    assert prepared.label_map.labels == [0, 7] * 240 and prepared.label_map.lengths == [160] * 480


@pytest.mark.usefixtures("wrapper")
@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("failing", 500, "segmenter failing failed .*RuntimeError: no weights in this folder"),
        ("leaving", 500, "segmenter leaving ended the process"),
        ("many", 422, "labels has 76799 instances"),
        (None, 422, "labels is missing"),
    ],
)
def test_without_labels_of_a_segmenter_one_request_fails(
    unlabelled: Files, files: Files, name: str | None, status: int, words: str
) -> None:
    with preparation_by(name) as prepare:
        for _ in range(2):
            with pytest.raises(RequestError, match=words) as caught:
                prepare(unlabelled)
            assert (caught.value.status, caught.value.field) == (status, "labels")
        assert [instance.label for instance in prepare(files).instances] == [3, 5, 7, 200]


def test_a_segmenter_that_cannot_be_loaded_stops_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Settings(tmp_path).segmenter == "table"
    with pytest.raises(InputError, match="segmenter is 'sam'; expected one of table"):
        Settings(tmp_path, segmenter="sam")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert Settings(tmp_path).segmenter is None
