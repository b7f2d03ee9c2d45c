"""Depth files: each format as other software writes it, and invalid files."""

import io
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics, RGBDFrame, read_depth
from thor2_jax.frames.instance_clouds import instance_cloud

METRES = np.random.default_rng(0).uniform(0.3, 2.5, (5, 7)).astype(np.float32)
UNITS = (METRES * 1000).astype(np.uint16)
UNITS[0, :2] = 0, 65_535


def write_exr(path: Path, **channels: np.ndarray) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="needs OpenEXR (extra exr)")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {name: np.ascontiguousarray(values) for name, values in channels.items()}) as file:
        file.write(str(path))


@pytest.mark.parametrize("name", ["d.png", "d.tiff"])
def test_integers_written_by_opencv(tmp_path: Path, name: str) -> None:
    assert cv2.imwrite(str(tmp_path / name), UNITS)
    depth = read_depth(tmp_path / name)
    assert depth.dtype == np.uint16
    np.testing.assert_array_equal(depth, UNITS)


def test_floats_in_tiff(tmp_path: Path) -> None:
    Image.fromarray(METRES).save(tmp_path / "pillow.tiff")
    assert cv2.imwrite(str(tmp_path / "opencv.tif"), METRES)
    for name in ("pillow.tiff", "opencv.tif"):
        depth = read_depth(tmp_path / name)
        assert depth.dtype == np.float32
        np.testing.assert_array_equal(depth, METRES)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, ">f4"])
@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 1)])
def test_floats_in_npy(tmp_path: Path, kind: Any, shape: tuple[int, ...]) -> None:
    np.save(tmp_path / "d.npy", METRES.astype(kind).reshape(shape))
    depth = read_depth(tmp_path / "d.npy")
    assert depth.dtype.kind == "f" and depth.dtype.isnative
    np.testing.assert_array_equal(depth, METRES.astype(kind))


@pytest.mark.parametrize(("kind", "expected"), [(np.uint16, np.uint16), (np.int32, np.uint16), (np.int64, np.uint16)])
def test_integers_in_npy(tmp_path: Path, kind: Any, expected: Any) -> None:
    np.save(tmp_path / "d.npy", UNITS.astype(kind))
    depth = read_depth(tmp_path / "d.npy")
    assert depth.dtype == expected
    np.testing.assert_array_equal(depth, UNITS)
    np.save(tmp_path / "d.npy", np.asfortranarray(UNITS.astype(np.uint32) + 70_000))
    assert read_depth(tmp_path / "d.npy").dtype == np.uint32
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npy"), UNITS.astype(np.uint32) + 70_000)


def test_floats_in_exr(tmp_path: Path) -> None:
    """The files are written by OpenEXR itself."""
    write_exr(tmp_path / "one.exr", Y=METRES)
    write_exr(tmp_path / "half.exr", V=METRES.astype(np.float16))
    write_exr(tmp_path / "several.exr", R=METRES * 0, A=METRES * 0, Z=METRES)
    write_exr(tmp_path / "gray.exr", R=METRES, G=METRES, B=METRES)
    for name in ("one", "several", "gray"):
        depth = read_depth(tmp_path / f"{name}.exr")
        assert depth.dtype == np.float32
        np.testing.assert_array_equal(depth, METRES)
    np.testing.assert_array_equal(read_depth(tmp_path / "half.exr"), METRES.astype(np.float16))


def test_invalid_exr_files(tmp_path: Path) -> None:
    write_exr(tmp_path / "two.exr", left=METRES, right=METRES)
    with pytest.raises(InputError, match=r"^depth: .*two\.exr has the channels left, right"):
        read_depth(tmp_path / "two.exr")
    whole = (tmp_path / "two.exr").read_bytes()
    for content in (b"", b"no EXR", whole[:50], whole[: len(whole) // 2]):
        (tmp_path / "bad.exr").write_bytes(content)
        with pytest.raises(InputError, match=r"^depth: .*bad\.exr is a damaged EXR file"):
            read_depth(tmp_path / "bad.exr")
    with pytest.raises(FileNotFoundError):
        read_depth(tmp_path / "absent.exr")


def test_exr_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "d.exr").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"^depth: .*d\.exr is an EXR file; expected .*OpenEXR"):
        read_depth(tmp_path / "d.exr")


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((5, 7), np.uint8),
        np.zeros((5, 7), bool),
        np.zeros((5, 7), np.complex64),
        np.zeros((5, 7), "S2"),
        np.zeros((5, 7, 3), np.float32),
        np.zeros(35, np.uint16),
        np.zeros((0, 7), np.float32),
        np.full((5, 7), -1),
        np.full((5, 7), 2**32),
    ],
)
def test_arrays_that_are_no_depth(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "d.npy", array)
    with pytest.raises(InputError, match=r"^depth: .*d\.npy has "):
        read_depth(tmp_path / "d.npy")


def test_damaged_npy_files(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, METRES)
    whole = stream.getvalue()
    objects = io.BytesIO()
    np.save(objects, np.array([[{}]], object))
    huge = whole.replace(b"(5, 7), }  ", b"(65536, 65536), }"[:11].ljust(11))
    for content in (b"", b"text", whole[:20], whole[:-3], objects.getvalue(), huge):
        (tmp_path / "d.npy").write_bytes(content)
        with pytest.raises(InputError, match=r"^depth: .*d\.npy "):
            read_depth(tmp_path / "d.npy")


def test_an_array_that_would_fill_memory(tmp_path: Path) -> None:
    header = str({"descr": "<f4", "fortran_order": False, "shape": (2**20, 2**20)}).encode().ljust(117) + b"\n"
    (tmp_path / "d.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(InputError, match="expected at most"):
        read_depth(tmp_path / "d.npy")


def frame(depth: np.ndarray, scale: float = 1000.0) -> RGBDFrame:
    labels = np.zeros(depth.shape, np.uint8)
    labels[5:25, 5:25], labels[30:38, 30:38] = 1, 2
    return RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth, labels, Intrinsics(50, 50, 20, 20, scale))


def test_depth_in_another_unit_is_asked_about() -> None:
    millimetres = np.full((40, 40), 700, np.uint16)
    right = frame(millimetres)
    assert right.has_usable_depth and instance_cloud(right, 1).reason is None
    for wrong in (frame(millimetres, 1.0), frame(millimetres, 1e6)):
        for label in (1, 2):
            assert not wrong.has_usable_depth
            assert "is depth_scale right? It is 1" in (instance_cloud(wrong, label).reason or "")
    floats = frame(millimetres.astype(np.float32))
    assert "in metres?" in (instance_cloud(floats, 1).reason or "")


def test_the_unit_is_right_if_one_instance_has_depth() -> None:
    depth = np.full((40, 40), 700, np.uint16)
    depth[30:38, 30:38] = 0
    reason = instance_cloud(frame(depth), 2).reason
    assert reason is not None and "depth_scale" not in reason
