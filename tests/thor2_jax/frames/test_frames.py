"""Frames: invalid input and files; depth in each format as other software writes it."""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from failures import Pickled
from image_files import encode_npy, png_of_zeros, write_frame_files
from PIL import Image, TiffImagePlugin
from refusals import assert_refused

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, encode_image, read_color, read_depth, read_frame, read_labels
from thor2_jax.frames.prepared_instance import instance_cloud
from training.readers.frames import frame_files

CAMERA = Intrinsics(500.0, 510.0, 3.5, 2.25)


def arrays(height: int = 5, width: int = 7) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    return {
        "color": rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
        "depth": rng.integers(300, 2000, (height, width), dtype=np.uint16),
        "labels": rng.integers(0, 4, (height, width), dtype=np.uint8),
        "intrinsics": CAMERA,
    }


# Intrinsics


PINHOLE = {"fx": 500, "fy": 500, "cx": 3, "cy": 2}
NO_NUMBERS = (math.nan, -math.inf, "500", True, [500], 1 + 0j, 1.1e9, -1.1e9, 10**400)
BAD_INTRINSICS: list[tuple[Any, str]] = [
    *((PINHOLE | {name: v}, rf"\.{name} is ") for name in (*PINHOLE, "depth_scale") for v in NO_NUMBERS),
    *((PINHOLE | {name: v}, rf"\.{name} is {v};") for name in ("fx", "fy", "depth_scale") for v in (0, -1.5)),
    *(({name: 1 for name in PINHOLE if name != missing}, f" lacks {missing};") for missing in PINHOLE),
    *((values, rf" is of type {type(values).__name__};") for values in (None, 3, "fx", b"fx")),
]


def test_intrinsics_are_a_mapping_of_numbers_of_any_kind() -> None:
    """The principal point may lie outside the image."""
    values = {"fx": np.int64(500), "fy": np.float32(501), "cx": -20, "cy": 2.5, "depth_scale": 5, "name": "left"}
    assert Intrinsics.of(values) == Intrinsics(500, 501, -20, 2.5, 5)
    assert sum(dataclasses.astuple(Intrinsics(*np.full(4, 200, np.uint8)))[:4]) == 800
    matrix, lens = jnp.array([[500, 0, 3], [0, 501, 2.5], [0, 0, 1]]), jnp.array([0.5, 0, 0, 0])
    assert Intrinsics.of(matrix) == Intrinsics.of({"K": matrix}) == Intrinsics(500, 501, 3, 2.5)
    assert Intrinsics(500, 501, 3, 2.5, distortion=lens).distortion == (0.5, 0, 0, 0)
    for bad, problem in BAD_INTRINSICS:
        assert_refused(f"^intrinsics{problem}", Intrinsics.of, bad)


# Frames


BAD_FIELDS: dict[str, list[Any]] = {
    r"intrinsics lacks cx, cy;": [{"fx": 1, "fy": 2}],
    r"color has shape .*expected \[H, W, 3\]$": [
        np.zeros(shape, np.uint8)
        for shape in ((5, 7), (5, 7, 1), (5, 7, 4), (0, 7, 3), (5, 0, 3), (35, 3), (1, 5, 7, 3))
    ],
    r"color has type \w+; expected uint8$": [
        np.zeros((5, 7, 3), kind) for kind in (np.float32, np.uint16, np.int8, bool)
    ],
    **{
        rf"{name} has shape .*\(5, 7\)": [np.zeros(shape, kind) for shape in ((7, 5), (5, 6), (5, 7, 1), (35,), ())]
        for name, kind in (("depth", np.uint16), ("labels", np.uint8))
    },
    r"depth has type \w+; expected": [
        np.ones((5, 7), kind) for kind in (np.uint8, np.int16, np.int32, bool, np.complex64, object)
    ],
    r"labels has type \w+; expected integers$": [np.ones((5, 7), kind) for kind in (np.float32, bool, object)],
    **{rf"{name} has rows of different lengths; .*\[H, W": [[[1], [1, 2]]] for name in ("color", "depth", "labels")},
    **{f"{name} .* masked": [np.ma.masked_less(arrays()[name], 400)] for name in ("color", "depth", "labels")},
    r"labels has the value -3": [np.where(np.eye(5, 7), -3, 0)],
    r"labels has the value 9223372036854775808;": [np.full((5, 7), 2**63, np.uint64)],
}
"""Error message, which begins with the name of the field -> values of the field."""


@pytest.mark.parametrize("problem", BAD_FIELDS)
def test_a_frame_refuses_bad_fields(problem: str) -> None:
    for value in BAD_FIELDS[problem]:
        assert_refused(f"^{problem}", RGBDFrame, **{**arrays(), problem.split()[0]: value})


@pytest.mark.parametrize(
    ("depth", "metres"),
    [
        (np.array([[65535, 1], [1234, 65534]], np.uint16), [[0, 1e-4], [0.1234, 6.5534]]),
        (np.array([[2**32 - 1, 1], [1234, 65535]], np.uint32), [[0, 1e-4], [0.1234, 6.5535]]),
        *((np.array([[0.5, np.nan], [np.inf, -np.inf]], f"f{n}"), [[0.5, 0], [0, 0]]) for n in (2, 4, 8)),
        (np.array([[0.5, 1e308, np.finfo(np.float32).max]]), [[0.5, 0, 0]]),
    ],
)
def test_depth_becomes_metres(depth: np.ndarray, metres: list[list[float]]) -> None:
    """Integers are multiples of a unit, here 0.1 mm; floats are metres. The largest value is no depth, like NaN."""
    before = depth.copy()
    frame = RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth, None, Intrinsics(1, 1, 0, 0, depth_scale=10_000))
    np.testing.assert_array_equal(frame.depth_m, np.array(metres, np.float32), strict=True)
    np.testing.assert_array_equal(depth, before)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.int64])
def test_instances_and_their_pixels(kind: Any) -> None:
    rng = np.random.default_rng(4)
    most = np.arange(1001).reshape(7, -1)
    for labels in (*(40 * rng.integers(0, 5, shape) for shape in ((1, 1), (5, 7), (31, 17))), most % 256, most):
        frame = RGBDFrame(**{**arrays(*labels.shape), "labels": labels.astype(kind)})
        assert list(frame.instance_pixels) == list(frame.instances) == sorted(set(frame.labels.ravel().tolist()) - {0})
        for label, pixels in frame.instance_pixels.items():
            assert type(label) is int
            np.testing.assert_array_equal(pixels, np.flatnonzero(frame.labels == label))
    more = dataclasses.replace(frame, labels=most + 1)
    assert_refused("labels has 1001 instances", getattr, more, "instances")


# Files


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Write the frame of `arrays()` to files."""
    return dict(vars(frame_files(write_frame_files(tmp_path, RGBDFrame(**arrays())))))


def test_a_frame_of_files(files: dict[str, Path]) -> None:
    frame, expected = read_frame(**files, depth_scale=5000), arrays()
    for name in ("color", "depth", "labels"):
        np.testing.assert_array_equal(getattr(frame, name), expected[name])
    assert frame.depth.dtype == np.uint16 and frame.intrinsics == dataclasses.replace(CAMERA, depth_scale=5000)
    del files["labels"]
    frame = read_frame(**files)
    assert frame.labels is None and frame.intrinsics == CAMERA and frame.depth_m.shape == (5, 7)
    for read in ("label_image", "instance_pixels", "instances"):
        assert_refused(r"^labels is None;", getattr, frame, read)


@pytest.mark.parametrize("name", ["color", "depth", "labels", "intrinsics"])
def test_missing_files_and_values_that_are_no_path(files: dict[str, Path], name: str) -> None:
    for value in (10**6, [files[name]], "a\0b"):
        refused = rf"^{name} is (of type (int|list)|'a\\x00b'); expected a path"
        assert_refused(refused, read_frame, **files | {name: value})
    assert_refused("^depth_scale is '1'", read_frame, **files, depth_scale="1")
    files[name].unlink()
    with pytest.raises(FileNotFoundError, match=str(files[name])):
        read_frame(**files)


@pytest.mark.parametrize("name", ["color", "depth", "labels"])
def test_damaged_images_and_other_formats(files: dict[str, Path], name: str) -> None:
    """Some formats that Pillow opens run other programs; only documented formats are read."""
    raw = files[name].read_bytes()
    others = [encode_image(arrays()["color"], kind) for kind in ("BMP", "GIF", "PPM", "EPS")]
    others.append(raw[:-13] + bytes([raw[-13] ^ 1]) + raw[-12:])  # decodable, with a wrong checksum
    for content in (b"", b"not an image", raw[:20], raw[: len(raw) // 2], *others):
        files[name].write_bytes(content)
        assert_refused(f"^{name}: {files[name]} [^<>]*$", read_frame, **files)  # without the name of an object


@pytest.mark.parametrize(
    ("read", "modes", "problem"),
    [
        (read_color, ("L", "P", "1", "LA", "I;16", "CMYK"), "^color: .*expected 8-bit RGB$"),
        (read_depth, ("L", "P", "RGB", "1"), "^depth: .*expected one channel of 16-bit"),
        (read_labels, ("RGB", "RGBA", "LA", "1"), "^labels: .*integers"),
    ],
)
def test_images_of_other_modes_are_refused(tmp_path: Path, read: Any, modes: tuple[str, ...], problem: str) -> None:
    for mode in modes:
        path = tmp_path / ("c.jpg" if mode == "CMYK" else "c.png")
        Image.new(mode, (7, 5)).save(path)
        assert_refused(problem, read, path)


def test_lossy_labels_are_refused(tmp_path: Path) -> None:
    mask = Image.fromarray(arrays()["labels"])
    mask.save(tmp_path / "lossy", "JPEG")
    mask.save(tmp_path / "lossy.tiff", "TIFF", compression="jpeg")
    deep = np.array([[0, 255], [256, 65535]], np.uint16)
    Image.fromarray(deep).save(tmp_path / "lossless.tiff", "TIFF", compression="tiff_lzw")
    np.testing.assert_array_equal(read_labels(tmp_path / "lossless.tiff"), deep)
    for name in ("lossy", "lossy.tiff"):
        assert_refused(f"^labels: .*{name}.*JPEG", read_labels, tmp_path / name)


def test_tiff_of_several_pages_or_turned_is_refused(tmp_path: Path) -> None:
    mask = Image.fromarray(arrays()["labels"])
    mask.save(tmp_path / "pages.tiff", save_all=True, append_images=[mask])
    mask.save(tmp_path / "turned.tiff", tiffinfo={274: 3})
    for name in ("pages.tiff", "turned.tiff"):
        assert_refused(f"^labels: .*{name}.*pages", read_labels, tmp_path / name)


def test_color_files_with_an_alpha_channel_of_16_bit_and_jpeg(tmp_path: Path) -> None:
    (tmp_path / "c.png").write_bytes(png_of_zeros(16, 12, 16))
    assert_refused("^color: .*;16", read_color, tmp_path / "c.png")
    rgba = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    Image.fromarray(rgba).save(tmp_path / "c.png")
    np.testing.assert_array_equal(read_color(tmp_path / "c.png"), rgba[..., :3])
    Image.new("RGB", (7, 5), (200, 100, 50)).save(tmp_path / "c.jpg", quality=95)
    np.testing.assert_allclose(read_color(tmp_path / "c.jpg"), np.full((5, 7, 3), (200.0, 100, 50)), atol=3)


@pytest.mark.parametrize("bits", [8, 16])
def test_tiff_colors_with_a_plane_for_each_channel(tmp_path: Path, bits: int) -> None:
    """Pillow reads 16-bit planes as if they had 8 bits, which gives other colours without an error."""
    planes = np.random.default_rng(0).integers(0, 256, (3, 5, 7)).astype(f"<u{bits // 8}")
    directory, size = TiffImagePlugin.ImageFileDirectory_v2(), planes[0].nbytes
    entries = {256: 7, 257: 5, 258: (bits,) * 3, 259: 1, 262: 2, 273: (0, size, 2 * size), 277: 3, 278: 5, 284: 2}
    for tag, value in entries.items():
        directory[tag] = value  # 273: offsets of the planes, to which Pillow adds that of the end of the directory
    (tmp_path / "c.tiff").write_bytes(b"II*\0\x08\0\0\0" + directory.tobytes(8) + planes.tobytes())
    if bits == 16:
        assert_refused("^color: .*;16", read_color, tmp_path / "c.tiff")
    else:
        np.testing.assert_array_equal(read_color(tmp_path / "c.tiff"), planes.transpose(1, 2, 0))


# Depth files


@pytest.mark.parametrize("value", [-1, 65_536])
def test_depth_files_of_32_bit(tmp_path: Path, value: int) -> None:
    depth = np.array([[0, 65_535]], np.int32)
    Image.fromarray(depth).save(tmp_path / "d.tiff")
    np.testing.assert_array_equal(read_depth(tmp_path / "d.tiff"), depth)
    depth[0, 0] = value
    Image.fromarray(depth).save(tmp_path / "d.tiff")
    assert_refused(rf"^depth: .*has values from .*{value}.*; expected 0 to 65535$", read_depth, tmp_path / "d.tiff")


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
