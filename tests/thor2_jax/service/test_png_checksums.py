"""The service and the library refuse a PNG with an invalid checksum, even if its pixels can be decoded."""

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

PIXELS = np.indices((12, 16)).sum(axis=0, dtype=np.uint8) % 2
DATA = zlib.compress(np.pad(PIXELS, ((0, 0), (1, 0))).tobytes(), 0)
CHUNKS = with_checksums(
    (b"IHDR", struct.pack(">IIBBBBB", 16, 12, 8, 3, 0, 0, 0)),
    (b"PLTE", bytes(6)),
    (b"tEXt", b"Title\0scene"),
    *((b"IDAT", part) for part in (DATA[:50], DATA[50:90], DATA[90:])),
    (b"tIME", bytes(7)),
    (b"IEND", b""),
)
"""An indexed image of zeros and ones, with its pixels in three chunks."""

OTHERS = {
    "color": encode_image(np.zeros((12, 16, 3), np.uint8)),
    "depth": encode_image(np.ones((12, 16), np.uint16)),
    "intrinsics": b'{"fx": 9, "fy": 9, "cx": 8, "cy": 6}',
}


def read(labels: bytes, folder: Path) -> np.ndarray:
    for name, content in {**OTHERS, "labels": labels}.items():
        (folder / name).write_bytes(content)
    return read_frame(**{name: folder / name for name in (*OTHERS, "labels")}).labels


def test_valid_checksums(tmp_path: Path) -> None:
    np.testing.assert_array_equal(decode_frame(**OTHERS, labels=png_file(CHUNKS)).labels, PIXELS)
    np.testing.assert_array_equal(read(png_file(CHUNKS), tmp_path), PIXELS)


@pytest.mark.parametrize("damage", ["checksum", "content"])
@pytest.mark.parametrize("k", range(7))
def test_invalid_checksum(tmp_path: Path, k: int, damage: str) -> None:
    kind, content, crc = CHUNKS[k]
    changed = bytes([*content[:-1], content[-1] ^ 1])
    chunk = (kind, content, crc ^ 1) if damage == "checksum" else (kind, changed, crc)
    labels = png_file([*CHUNKS[:k], chunk, *CHUNKS[k + 1 :]])
    with pytest.raises(RequestError) as error:
        decode_frame(**OTHERS, labels=labels)
    assert (error.value.status, error.value.field) == (422, "labels")
    with pytest.raises(InputError, match="^labels: .* is damaged"):
        read(labels, tmp_path)
