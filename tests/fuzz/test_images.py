"""Images whose chunks have valid checksums, that would fill memory, or that are of another kind."""

import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from helpers import encode_image, png_file, with_checksums
from hypothesis import given
from hypothesis import strategies as st

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import read_color
from thor2_jax.testing import damaged

from .test_files import COLOR, READERS


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
    content, read, is_valid = READERS[name]
    parts = chunks(content)
    k = data.draw(st.integers(0, len(parts) - 1))
    kind, body = parts[k]
    if kind == b"IDAT" and data.draw(st.booleans()):
        body = zlib.compress(data.draw(damaged(zlib.decompress(body))))
    elif body:
        body = data.draw(damaged(body, 1))
    path = tmp_path / name
    path.write_bytes(png_file(with_checksums(*parts[:k], (kind, body), *parts[k + 1 :])))
    image = attempt(lambda: read(path))
    assert image is None or is_valid(image)


@pytest.mark.parametrize("size", [(65_000, 65_000), (2**31 - 1, 2**31 - 1), (13_000, 13_000), (170_000_000, 1)])
def test_an_image_that_would_fill_memory_is_refused(size: tuple[int, int], attempt: Any, tmp_path: Path) -> None:
    """The file has a few hundred kilobytes of compressed zeros, or little more than a header."""
    rows = zlib.compress(bytes(min((size[0] * 3 + 1) * size[1], 2**26)), 1)
    header = struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)
    path = tmp_path / "bomb.png"
    path.write_bytes(png_file(with_checksums((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))))
    with pytest.raises(InputError, match=rf"bomb\.png .*({size[0] * size[1]}|{size[0]} x {size[1]}) pixels"):
        attempt(lambda: read_color(path), ())


def test_text_that_would_fill_memory(attempt: Any, tmp_path: Path) -> None:
    parts = chunks(encode_image(COLOR))
    bomb = (b"zTXt", b"key\0\0" + zlib.compress(bytes(2**26), 9))
    path = tmp_path / "bomb.png"
    path.write_bytes(png_file(with_checksums(parts[0], bomb, *parts[1:])))
    attempt(lambda: read_color(path))


@pytest.mark.parametrize("kind", ["BMP", "GIF", "PPM", "EPS"])
def test_other_kinds_of_images_are_refused(kind: str, tmp_path: Path) -> None:
    """Some formats that Pillow opens run other programs; only documented formats are read."""
    path = tmp_path / "color.png"
    path.write_bytes(encode_image(COLOR, kind))
    with pytest.raises(InputError, match="color.png"):
        read_color(path)
