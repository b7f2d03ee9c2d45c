"""Images in ROS messages to arrays."""

import struct
import tracemalloc
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from recording_files import compressed, compressed_depth, image
from refusals import assert_refused

from thor2_jax.frames.frames import encode_image
from thor2_jax.recordings.messages import color_image, depth_image, image_kind

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (5, 7, 3), dtype=np.uint8)
DEPTH = RNG.integers(0, 3000, (5, 7), dtype=np.uint16)
PNG = encode_image(COLOR, "PNG")
RGB = image(COLOR, "rgb8")


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "RGB8"])
def test_colour_encodings(encoding: str) -> None:
    pixels = COLOR if encoding.lower().startswith("rgb") else COLOR[..., ::-1]
    if "a" in encoding:
        pixels = np.dstack([pixels, np.full((5, 7), 9, np.uint8)])
    message = image(pixels, encoding, padding=3)
    assert image_kind(message) == "color"
    np.testing.assert_array_equal(color_image(message), COLOR)


@pytest.mark.parametrize(
    ("pixels", "encoding"),
    [(DEPTH, "16UC1"), (DEPTH.astype(">u2"), "mono16"), *(((DEPTH / 1000).astype(t), "32FC1") for t in ("<f4", ">f4"))],
)
def test_depth_encodings(pixels: np.ndarray, encoding: str) -> None:
    message = image(pixels, encoding, padding=2)
    assert image_kind(message) == "depth"
    native = pixels.astype(pixels.dtype.newbyteorder("="))
    np.testing.assert_array_equal(depth_image(message), native, strict=True)


def test_raw_images_of_too_many_pixels() -> None:
    message = image(np.zeros((1, 1, 6), np.uint8), "rgb8")
    message.width, message.height, message.step = 2**13, 2**13 + 1, 2**15
    message.data = np.zeros(message.step * message.height, np.uint8)
    tracemalloc.start()
    assert_refused("8192 x 8193 pixels; expected at most", color_image, message)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_compressed_images() -> None:
    smooth = np.full((16, 16, 3), (200, 60, 20), np.uint8)
    for message, read, kind, expected, tolerance in (
        (compressed(PNG, "bgr8; png compressed bgr8"), color_image, "color", COLOR, 0),
        (compressed(encode_image(smooth, "JPEG", quality=95), "jpeg"), color_image, "color", smooth, 5),
        (compressed_depth(DEPTH), depth_image, "depth", DEPTH, 0),
        (compressed(encode_image(DEPTH, "PNG"), "png"), depth_image, "depth", DEPTH, 0),
    ):
        np.testing.assert_allclose(read(message).astype(int), expected, rtol=0, atol=tolerance)
        assert image_kind(message) == kind


def test_compressed_float_depth() -> None:
    metres = np.linspace(0.3, 2.5, 35, dtype=np.float32).reshape(5, 7)
    # compressed_depth_image_transport: depth_quantization 100, depth_max 10.
    scale, offset = 100 * 101.0, 1 - 100 * 101.0 / 10
    quantized = np.round(scale / metres + offset).astype(np.uint16)
    quantized[0, 0] = 0
    content = struct.pack("<iff", 0, scale, offset) + encode_image(quantized, "PNG")
    read = depth_image(compressed(content, "32FC1; compressedDepth png"))
    assert read[0, 0] == 0
    np.testing.assert_allclose(read.ravel()[1:], metres.ravel()[1:], rtol=2e-4)
    damaged = struct.pack("<iff", 0, 3e38, 99.5) + encode_image(np.full((1, 1), 100, np.uint16), "PNG")
    assert np.isinf(depth_image(compressed(damaged, "32FC1; compressedDepth png")))


@pytest.mark.parametrize(
    ("read", "message"),
    [
        *((color_image, SimpleNamespace(**vars(RGB) | size)) for size in ({"step": 4}, {"height": 50}, {"width": 0})),
        (color_image, image(DEPTH.astype(np.uint8), "mono8")),
        (color_image, image(COLOR, "bayer_rggb8")),
        (depth_image, RGB),
        (color_image, compressed(PNG[:40], "png")),
        (color_image, compressed(PNG[:-16] + bytes(4) + PNG[-12:], "png")),  # a wrong checksum
        (color_image, compressed(encode_image(DEPTH, "PNG"), "png")),
        (depth_image, compressed(PNG, "16UC1; png compressed")),
        (depth_image, compressed(b"123", "16UC1; compressedDepth png")),
        (depth_image, compressed(b"0" * 99, "16UC1; compressedDepth rvl")),
    ],
)
def test_other_images_are_refused(read: Any, message: Any) -> None:
    assert image_kind(compressed(b"damaged", "png")) == "other"
    assert_refused("expected", read, message)
