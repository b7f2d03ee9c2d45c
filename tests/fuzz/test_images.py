"""Damaged frames: PNG and JPEG images, intrinsics."""

import io
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import encode_image, png_file, with_checksums
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import read_color, read_depth, read_intrinsics, read_labels
from thor2_jax.testing import damaged

RNG = np.random.default_rng(0)
SHAPE = (24, 17)


COLOR = RNG.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
PALETTE = Image.fromarray(RNG.integers(0, 4, SHAPE, dtype=np.uint8)).convert("P")


def npy_file(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


FILES: dict[str, tuple[Callable[[Path], Any], bytes]] = {
    "color.png": (read_color, encode_image(COLOR, "PNG")),
    "alpha.png": (read_color, encode_image(np.dstack([COLOR, COLOR[..., 0]]), "PNG")),
    "color.jpg": (read_color, encode_image(COLOR, "JPEG")),
    "depth.png": (read_depth, encode_image(RNG.integers(0, 2**16, SHAPE).astype(np.uint16), "PNG")),
    "depth.tiff": (read_depth, encode_image(RNG.integers(0, 2**16, SHAPE).astype(np.uint16), "TIFF")),
    "metres.tiff": (read_depth, encode_image(RNG.random(SHAPE, dtype=np.float32), "TIFF")),
    "depth.npy": (read_depth, npy_file(RNG.random(SHAPE, dtype=np.float32))),
    "labels.png": (read_labels, encode_image(RNG.integers(0, 9, SHAPE, dtype=np.uint8), "PNG")),
}


def chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    parts, at = [], 8
    while at + 8 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        parts.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    return parts


@pytest.mark.parametrize("name", FILES)
@given(data=st.data())
def test_images(name: str, data: st.DataObject, attempt: Any, tmp_path: Path) -> None:
    read, content = FILES[name]
    path = tmp_path / name
    path.write_bytes(data.draw(damaged(content)))
    image = attempt(lambda: read(path))
    if image is not None:
        assert image.ndim in (2, 3) and image.dtype.kind in "uf" and image.size > 0


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith("png")])
@given(data=st.data())
def test_damaged_png_chunks_with_valid_checksums(name: str, data: st.DataObject, attempt: Any, tmp_path: Path) -> None:
    read, content = FILES[name]
    parts = chunks(content)
    k = data.draw(st.integers(0, len(parts) - 1))
    kind, body = parts[k]
    if kind == b"IDAT" and data.draw(st.booleans()):
        body = zlib.compress(data.draw(damaged(zlib.decompress(body))))
    elif body:
        body = data.draw(damaged(body, 1))
    path = tmp_path / name
    path.write_bytes(png_file(with_checksums(*parts[:k], (kind, body), *parts[k + 1 :])))
    attempt(lambda: read(path))


@pytest.mark.parametrize("size", [(65_000, 65_000), (2**31 - 1, 2**31 - 1), (13_000, 13_000), (170_000_000, 1)])
def test_an_image_that_would_fill_memory_is_refused(size: tuple[int, int], attempt: Any, tmp_path: Path) -> None:
    """The file has a few hundred kilobytes of compressed zeros, or little more than a header."""
    rows = zlib.compress(bytes(min((size[0] * 3 + 1) * size[1], 2**26)), 1)
    path = tmp_path / "bomb.png"
    path.write_bytes(
        png_file(
            with_checksums((b"IHDR", struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b""))
        )
    )
    assert attempt(lambda: read_color(path)) is None
    with pytest.raises(InputError, match=rf"bomb\.png .*{size[0] * size[1]} pixels"):
        read_color(path)


def test_text_that_would_fill_memory(attempt: Any, tmp_path: Path) -> None:
    parts = chunks(FILES["color.png"][1])
    bomb = (b"zTXt", b"key\0\0" + zlib.compress(bytes(2**26), 9))
    path = tmp_path / "bomb.png"
    path.write_bytes(png_file(with_checksums(parts[0], bomb, *parts[1:])))
    attempt(lambda: read_color(path))


def test_other_kinds_of_images_are_refused(tmp_path: Path) -> None:
    """Some formats that Pillow opens run other programs; only documented formats are read."""
    for kind in ("BMP", "GIF", "PPM", "EPS"):
        path = tmp_path / "color.png"
        path.write_bytes(encode_image(COLOR, kind))
        with pytest.raises(InputError, match="color.png"):
            read_color(path)


INTRINSICS = json.dumps({"fx": 600.5, "fy": 601.0, "cx": 320, "cy": 240.25, "depth_scale": 1000.0}).encode()


CAMERA_INFO = b"""\
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [600.5, 0, 320, 0, 601.0, 240.25, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0.001, 0, 0]}
"""
CAMERAS = {
    "json": INTRINSICS,
    "yaml": CAMERA_INFO,
    "txt": b"600.5 0 320\n0 601 240.25\n0 0 1\n",
    "npy": npy_file(np.array([[600.5, 0, 320], [0, 601, 240.25], [0, 0, 1]])),
}


@pytest.mark.parametrize("kind", CAMERAS)
@given(data=st.data())
def test_intrinsics(kind: str, data: st.DataObject, attempt: Any, tmp_path: Path) -> None:
    path = tmp_path / f"k.{kind}"
    path.write_bytes(data.draw(damaged(CAMERAS[kind])))
    intrinsics = attempt(lambda: read_intrinsics(path))
    if intrinsics is not None:
        assert (
            intrinsics.fx > 0
            and np.isfinite([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, intrinsics.depth_scale]).all()
        )


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 10**6,
        b"1" * 10**5,
        b'{"fx": ' * 10**5,
        INTRINSICS.replace(b"600.5", b"9" * 400),
        INTRINSICS.replace(b"1000.0", b"1" + b"9" * 30),
    ],
)
def test_odd_json(content: bytes, attempt: Any, tmp_path: Path) -> None:
    path = tmp_path / "k.json"
    path.write_bytes(content)
    assert attempt(lambda: read_intrinsics(path)) is None
