"""The service and the library refuse a PNG with an invalid checksum, even if its pixels can be decoded."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers import encode_image, png_file, with_checksums

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import read_frame
from thor2_jax.service.decoding import decode_frame
from thor2_jax.service.problem import RequestError

Chunk = tuple[bytes, bytes, int]
KINDS = (b"IHDR", b"PLTE", b"tEXt", b"IDAT", b"IDAT", b"IDAT", b"tIME")


@pytest.fixture
def labels() -> list[Chunk]:
    """An indexed image of zeros and ones, 12 x 16, with its pixels in three chunks, and a text and a date chunk."""
    rows = np.pad(np.indices((12, 16)).sum(axis=0, dtype=np.uint8) % 2, ((0, 0), (1, 0)))
    data = zlib.compress(rows.tobytes(), 0)
    parts = (data[:50], data[50:90], data[90:])
    return with_checksums(
        (b"IHDR", struct.pack(">IIBBBBB", 16, 12, 8, 3, 0, 0, 0)),
        (b"PLTE", bytes(6)),
        (b"tEXt", b"Title\0scene"),
        *((b"IDAT", part) for part in parts),
        (b"tIME", bytes(7)),
        (b"IEND", b""),
    )


@pytest.fixture
def others() -> dict[str, bytes]:
    return {
        "color": encode_image(np.zeros((12, 16, 3), np.uint8)),
        "depth": encode_image(np.ones((12, 16), np.uint16)),
        "intrinsics": json.dumps({"fx": 9, "fy": 9, "cx": 8, "cy": 6}).encode(),
    }


def read(files: dict[str, bytes], folder: Path) -> np.ndarray:
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return read_frame(**{name: folder / name for name in files}).labels


def test_valid_checksums(labels: list[Chunk], others: dict[str, bytes], tmp_path: Path) -> None:
    files = {**others, "labels": png_file(labels)}
    expected = np.indices((12, 16)).sum(axis=0) % 2
    np.testing.assert_array_equal(decode_frame(**files).labels, expected)
    np.testing.assert_array_equal(read(files, tmp_path), expected)


@pytest.mark.parametrize("damage", ["checksum", "content"])
@pytest.mark.parametrize("k", range(len(KINDS)), ids=[f"{kind.decode()} {k}" for k, kind in enumerate(KINDS)])
def test_invalid_checksum(labels: list[Chunk], others: dict[str, bytes], tmp_path: Path, k: int, damage: str) -> None:
    kind, content, crc = labels[k]
    assert kind == KINDS[k]
    changed = bytes([*content[:-1], content[-1] ^ 1])
    labels[k] = (kind, content, crc ^ 1) if damage == "checksum" else (kind, changed, crc)
    files = {**others, "labels": png_file(labels)}
    with pytest.raises(RequestError) as error:
        decode_frame(**files)
    assert (error.value.status, error.value.field) == (422, "labels")
    with pytest.raises(InputError, match="^labels: .* is damaged"):
        read(files, tmp_path)
