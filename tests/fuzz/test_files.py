"""Damaged files that are read alone: images, intrinsics, tables, point clouds, answers, metrics and baselines."""

import json
import os
import struct
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_files import ocid_scene, pack_pcd, points_of
from hypothesis import given
from hypothesis import strategies as st
from image_files import encode_npy, png_file, png_of_zeros
from processes import HANG
from refusals import assert_refused

from thor2_jax.frames.frames import Intrinsics, encode_image, read_color, read_depth, read_labels
from thor2_jax.frames.intrinsics import read_intrinsics
from thor2_jax.testing import damaged
from training.baselines.baseline import StoredBaseline
from training.evaluation.answers import AnswerFile, FrameAnswers, InstancePrediction
from training.objects.meshes import read_names
from training.readers.ocid import read_organized_points
from training.train_run import read_metrics

RNG = np.random.default_rng(0)
SHAPE = (24, 17)
COLOR = RNG.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
DEPTH = RNG.integers(0, 2**16, SHAPE).astype(np.uint16)
METRES = RNG.random(SHAPE, dtype=np.float32)

CAMERA_INFO = b"""\
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [600.5, 0, 320, 0, 601.0, 240.25, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0, 0]}
"""
CAMERA = json.dumps({"fx": 600.5, "fy": 601.0, "cx": 320, "cy": 240.25, "depth_scale": 1000.0}).encode()
MATRIX = np.array([[600.5, 0, 320], [0, 601, 240.25], [0, 0, 1]])

EVALUATION = {"runs": ["a"], "classes": ["mug", "bowl"]}
BASELINE = StoredBaseline({"a": np.arange(6.0).reshape(2, 3), "b": np.array([1], np.int32)}, 1.5)
ROWS = [{"fold": 0, "classifier": "ce", "epoch": k, "loss": 0.5, "accuracy": 0.75} for k in range(3)]


def written(write: Callable[[Path], Any]) -> bytes:
    """Return the content of the file that a function writes."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "file")
        return (Path(folder) / "file").read_bytes()


def write_answers(path: Path) -> None:
    file = AnswerFile(path, EVALUATION)
    prediction = InstancePrediction(1, "mug", probabilities=np.array([[0.25, 0.75]], np.float32))
    for number in range(2):
        instances = [prediction, InstancePrediction(2, "can", reason="few")]
        file.append(FrameAnswers(f"frame {number}", {"light": "1"}, 0.5, instances))


def is_image(image: np.ndarray) -> bool:
    return image.ndim in (2, 3) and image.dtype.kind in "uf" and image.size > 0


def is_camera(k: Intrinsics) -> bool:
    return k.fx > 0 and bool(np.isfinite([k.fx, k.fy, k.cx, k.cy, k.depth_scale]).all())


def are_names(names: dict[Any, Any]) -> bool:
    return all(type(a) is type(b) is str for a, b in names.items())


def are_points(points: np.ndarray) -> bool:
    return points.ndim == 3 and points.shape[2] == 3


def are_answers(file: AnswerFile) -> bool:
    tables = [instance.probabilities for frame in file.frames for instance in frame.instances]
    return all(table is None or (table.dtype, table.ndim) == (np.float32, 2) for table in tables)


def are_metrics(rows: list[dict[str, Any]]) -> bool:
    return all({"fold", "classifier", "epoch"} <= row.keys() for row in rows)


def is_the_baseline(read: StoredBaseline) -> bool:
    same = (read.temperature, read.arrays.keys()) == (1.5, BASELINE.arrays.keys())
    return same and all(np.array_equal(read.arrays[name], array) for name, array in BASELINE.arrays.items())


READERS: dict[str, tuple[bytes, Callable[[Path], Any], Callable[[Any], bool]]] = {
    "color.png": (encode_image(COLOR), read_color, is_image),
    "alpha.png": (encode_image(np.dstack([COLOR, COLOR[..., 0]])), read_color, is_image),
    "color.jpg": (encode_image(COLOR, "JPEG"), read_color, is_image),
    "depth.png": (encode_image(DEPTH), read_depth, is_image),
    "depth.tiff": (encode_image(DEPTH, "TIFF"), read_depth, is_image),
    "metres.tiff": (encode_image(METRES, "TIFF"), read_depth, is_image),
    "depth.npy": (encode_npy(METRES), read_depth, is_image),
    "labels.png": (encode_image(RNG.integers(0, 9, SHAPE, dtype=np.uint8)), read_labels, is_image),
    "camera.json": (CAMERA, read_intrinsics, is_camera),
    "camera.yaml": (CAMERA_INFO, read_intrinsics, is_camera),
    "camera.txt": (b"600.5 0 320\n0 601 240.25\n0 0 1\n", read_intrinsics, is_camera),
    "camera.npy": (encode_npy(MATRIX), read_intrinsics, is_camera),
    "names.json": (b'{"mug": "025_mug", "bowl": "024_bowl"}', read_names, are_names),
    "names.yaml": (b"mug: 025_mug\nbowl: 024_bowl\n", read_names, are_names),
    "answers.jsonl": (written(write_answers), lambda path: AnswerFile(path, EVALUATION), are_answers),
    "metrics.jsonl": ("".join(json.dumps(row) + "\n" for row in ROWS).encode(), read_metrics, are_metrics),
    "baseline.safetensors": (
        written(lambda path: BASELINE.write(path, ["mug"], 2.0)),
        lambda path: StoredBaseline.read(path, ["mug"]),
        is_the_baseline,
    ),
}
color, depth, labels = ocid_scene()
for kind in ("ascii", "binary"):
    cloud = pack_pcd(points_of(depth), color, labels, kind)
    READERS[f"{kind}.pcd"] = cloud, read_organized_points, are_points


def check(path: Path, content: bytes, attempt: Any) -> None:
    """Read a file with some content, which is refused or gives a valid result."""
    _, read, is_valid = READERS[path.name]
    path.write_bytes(content)
    result = attempt(lambda: read(path))
    assert result is None or is_valid(result)


@pytest.mark.parametrize("name", READERS)
@given(data=st.data())
def test_damaged_files(name: str, data: st.DataObject, attempt: Any, tmp_path: Path) -> None:
    check(tmp_path / name, data.draw(damaged(READERS[name][0])), attempt)


def chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    parts, at = [], 8
    while at + 8 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        parts.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    return parts


@pytest.mark.parametrize("name", [name for name in READERS if name.endswith("png")])
@given(data=st.data())
def test_damaged_png_chunks_with_valid_checksums(name: str, data: st.DataObject, attempt: Any, tmp_path: Path) -> None:
    parts = chunks(READERS[name][0])
    k = data.draw(st.integers(0, len(parts) - 1))
    kind, body = parts[k]
    if kind == b"IDAT" and data.draw(st.booleans()):
        body = zlib.compress(data.draw(damaged(zlib.decompress(body))))
    elif body:
        body = data.draw(damaged(body, 1))
    check(tmp_path / name, png_file(*parts[:k], (kind, body), *parts[k + 1 :]), attempt)


@pytest.mark.parametrize("size", [(65_000, 65_000), (2**31 - 1, 2**31 - 1), (13_000, 13_000), (170_000_000, 1)])
def test_an_image_that_would_fill_memory_is_refused(size: tuple[int, int], attempt: Any, tmp_path: Path) -> None:
    """The file has a few hundred kilobytes of compressed zeros, or little more than a header."""
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of_zeros(*size))
    pixels = rf"bomb\.png .*({size[0] * size[1]}|{size[0]} x {size[1]}) pixels"
    assert_refused(pixels, attempt, lambda: read_color(path), ())


def test_bad_readers_are_failures(attempt: Any) -> None:
    def refuse() -> None:
        raise OSError("two\nlines")

    with pytest.raises(AssertionError, match="two"):
        attempt(refuse)
    with pytest.raises(AssertionError, match="the reader takes"):
        attempt(lambda: len(b"x" * 2**26), most=2**25)
    with pytest.raises(ChildProcessError):
        attempt(lambda: os._exit(3))
    with pytest.raises(TimeoutError):
        attempt(lambda: time.sleep(2 * HANG), seconds=0)
