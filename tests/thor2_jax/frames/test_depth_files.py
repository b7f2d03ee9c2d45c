"""Depth files: each format as other software writes it, and invalid files."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from failures import Pickled
from image_files import encode_npy
from PIL import Image
from refusals import assert_refused

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, read_depth
from thor2_jax.frames.prepared_instance import instance_cloud

METRES = np.random.default_rng(0).uniform(0.3, 2.5, (5, 7)).astype(np.float32)
UNITS = (METRES * 1000).astype(np.uint16)
UNITS[0, :2] = 0, 65_535


def write_exr(path: Path, **channels: np.ndarray) -> None:
    openexr = pytest.importorskip("OpenEXR", reason="needs OpenEXR (extra exr)")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {name: np.ascontiguousarray(values) for name, values in channels.items()}) as file:
        file.write(str(path))


def assert_depth(path: Path, expected: np.ndarray) -> None:
    np.testing.assert_array_equal(read_depth(path), expected, strict=True)


@pytest.mark.parametrize(("name", "values"), [("d.png", UNITS), ("d.tiff", UNITS), ("d.tif", METRES)])
def test_images_written_by_opencv_and_pillow(tmp_path: Path, name: str, values: np.ndarray) -> None:
    assert cv2.imwrite(str(tmp_path / name), values)
    assert_depth(tmp_path / name, values)
    Image.fromarray(values).save(tmp_path / name)
    assert_depth(tmp_path / name, values)


def test_formats_of_depth_are_those_in_the_message(tmp_path: Path) -> None:
    """Pillow does not read floats of 64 bits in TIFF, the default of NumPy."""
    assert cv2.imwrite(str(tmp_path / "d.tiff"), METRES.astype(np.float64))
    np.savez(tmp_path / "d.npz", METRES)
    for name in ("d.tiff", "d.npz"):
        assert_refused(f"^depth: .*{name}.*32-bit.*NPY", read_depth, tmp_path / name)


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        (METRES.astype(np.float16), METRES.astype(np.float16)),
        (METRES[:, :, None], METRES),
        (METRES.astype(">f4"), METRES),
        (UNITS, UNITS),
        (UNITS.astype(np.int64), UNITS),
        (np.asfortranarray(UNITS.astype(np.int64) + 70_000), UNITS.astype(np.uint32) + 70_000),
    ],
)
def test_arrays_in_npy(tmp_path: Path, written: np.ndarray, expected: np.ndarray) -> None:
    np.save(tmp_path / "d.npy", written)
    assert_depth(tmp_path / "d.npy", expected)


@pytest.mark.parametrize(
    "channels",
    [
        {"V": METRES.astype(np.float16)},
        {"R": METRES * 0, "A": METRES * 0, "Z": METRES},
        {"R": METRES, "G": METRES, "B": METRES},
    ],
    ids=["one", "several", "gray"],
)
def test_floats_in_exr(tmp_path: Path, channels: dict[str, np.ndarray]) -> None:
    write_exr(tmp_path / "d.exr", **channels)
    assert_depth(tmp_path / "d.exr", METRES.astype(np.float16) if "V" in channels else METRES)


def test_invalid_exr_files(tmp_path: Path) -> None:
    write_exr(tmp_path / "two.exr", left=METRES, right=METRES)
    assert_refused(r"^depth: .*two\.exr has the channels left, right", read_depth, tmp_path / "two.exr")
    whole = (tmp_path / "two.exr").read_bytes()
    for content in (b"", b"no EXR", whole[:50], whole[: len(whole) // 2]):
        (tmp_path / "bad.exr").write_bytes(content)
        assert_refused(r"^depth: .*bad\.exr is a damaged EXR file", read_depth, tmp_path / "bad.exr")


def test_exr_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "d.exr").write_bytes(b"")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    assert_refused(r"^depth: .*d\.exr is an EXR file; expected .*OpenEXR", read_depth, tmp_path / "d.exr")


NO_DEPTH = (
    *(np.zeros((5, 7), kind) for kind in (np.uint8, np.complex64)),
    *(np.zeros(shape, np.float32) for shape in ((5, 7, 3), (35,), (0, 7))),
    *(np.full((5, 7), value) for value in (-1, 2**32)),
)


def test_arrays_that_are_no_depth_and_damaged_npy_files(tmp_path: Path) -> None:
    whole = encode_npy(METRES)
    huge = whole.replace(b"(5, 7), }" + b" " * 12, b"(1048576, 1048576), }")
    pickled = encode_npy(np.array([[Pickled()]], object))
    cases = [(encode_npy(array), "has ") for array in NO_DEPTH]
    cases += [(content, "is a damaged NPY file") for content in (b"", whole[:20], whole[:-3], pickled)]
    for content, message in [*cases, (huge, ".*expected at most")]:
        (tmp_path / "d.npy").write_bytes(content)
        assert_refused(rf"^depth: .*d\.npy {message}", read_depth, tmp_path / "d.npy")


def frame(depth: np.ndarray, scale: float = 1000.0) -> RGBDFrame:
    labels = np.zeros(depth.shape, np.uint8)
    labels[5:25, 5:25], labels[30:38, 30:38] = 1, 2
    return RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth, labels, Intrinsics(50, 50, 20, 20, scale))


def test_depth_in_another_unit_is_asked_about() -> None:
    millimetres = np.full((40, 40), 700, np.uint16)
    right = frame(millimetres)
    assert right.has_usable_depth and instance_cloud(right, 1).reason is None
    for scale in (1.0, 1e6):
        wrong = frame(millimetres, scale)
        assert not wrong.has_usable_depth
        assert "is depth_scale right? It is 1" in (instance_cloud(wrong, 2).reason or "")
    assert "in metres?" in (instance_cloud(frame(millimetres.astype(np.float32)), 1).reason or "")
    assert "no pixel has depth" in (instance_cloud(frame(np.zeros_like(millimetres)), 1).reason or "")
    millimetres[30:38, 30:38] = 0  # the other instance has depth
    reason = instance_cloud(frame(millimetres), 2).reason
    assert reason is not None and "depth_scale" not in reason
