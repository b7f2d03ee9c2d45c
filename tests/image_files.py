"""Small frames, and files of images and frames."""

import dataclasses
import io
import json
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL.PngImagePlugin import putchunk

import thor2_jax as thor2
from thor2_jax.frames.frames import encode_image
from thor2_jax.frames.prepared_instance import PreparedInstance, instance_cloud

SAMPLES = Path(thor2.__file__).parent / "service" / "page" / "samples"
"""The sample frames of the service's page."""


def encode_npy(array: np.ndarray, **options: Any) -> bytes:
    """Return an NPY file's bytes."""
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def png_file(*chunks: tuple[bytes, bytes]) -> bytes:
    """Return a PNG file of chunks (kind, content), which may be invalid, with their correct checksums."""
    stream = io.BytesIO()
    for kind, content in chunks:
        putchunk(stream, kind, content)
    return b"\x89PNG\r\n\x1a\n" + stream.getvalue()


def png_of_zeros(width: int, height: int, bits: int = 8) -> bytes:
    """Return an RGB image of zeros as a PNG; its pixels end after 64 MiB, so that a larger image is damaged.

    Pillow cannot write one of 16 bits for each channel.
    """
    header = struct.pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0)
    rows = zlib.compress(bytes(min((width * 3 * bits // 8 + 1) * height, 2**26)), 1)
    return png_file((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))


def write_frame_files(folder: Path, frame: thor2.RGBDFrame, names: Mapping[int, str] | None = None) -> Path:
    """Write a frame as `FrameFolder` reads it: its mask if it has labels, and labels.json if names are given."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "color.png").write_bytes(encode_image(frame.color))
    (folder / "depth.png").write_bytes(encode_image(frame.depth.astype(np.uint16)))
    if frame.labels is not None:
        (folder / "mask.png").write_bytes(encode_image(frame.labels.astype(np.uint8)))
    k = frame.intrinsics
    (folder / "intrinsics.json").write_text(json.dumps({"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy}))
    if names is not None:
        (folder / "labels.json").write_text(json.dumps({"labels": {str(label): name for label, name in names.items()}}))
    return folder


def frame_of_squares(
    squares: Mapping[int, tuple[int, int, ArrayLike]], side: int = 40, shape: tuple[int, int] = (120, 160)
) -> thor2.RGBDFrame:
    """Return a frame with squares 0.7 m away, before a wall: label -> row, column, colour."""
    color, labels = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8)
    depth = np.full(shape, 900, np.uint16)
    for label, (row, column, rgb) in squares.items():
        here = slice(row, row + side), slice(column, column + side)
        color[here], labels[here], depth[here] = rgb, label, 700
    return thor2.RGBDFrame(color, depth, labels, thor2.Intrinsics(600.0, 600.0, 79.5, 59.5))


def small_frame(seed: int = 0) -> thor2.RGBDFrame:
    """Return a frame of 120 x 90 pixels with the instances 1 and 4, in random colours."""
    first, second = np.random.default_rng(seed).integers(0, 256, (2, 40, 40, 3))
    return frame_of_squares({1: (10, 10, first), 4: (30, 60, second)}, shape=(90, 120))


def label_image(
    *rectangles: tuple[int, int, int, int, int], shape: tuple[int, int] = (240, 320), dtype: Any = np.uint8
) -> NDArray[Any]:
    """Return labels; each rectangle is (label, first row, end row, first column, end column)."""
    labels = np.zeros(shape, dtype)
    for label, top, bottom, left, right in rectangles:
        labels[top:bottom, left:right] = label
    return labels


def patches() -> NDArray[np.uint8]:
    """Return label images of three usable instances and one that is too small."""
    return label_image((3, 20, 100, 20, 90), (5, 200, 203, 10, 13), (7, 20, 60, 150, 250), (200, 120, 220, 100, 150))


def tilted(labels: np.ndarray) -> thor2.RGBDFrame:
    """Return a frame of a tilted plane with random colours; depth grows to the right."""
    depth = np.broadcast_to(600 + np.arange(320) // 2, (240, 320)).astype(np.uint16)
    color = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    return thor2.RGBDFrame(color, depth, labels, thor2.Intrinsics(600.0, 600.0, 159.5, 119.5))


FRAME_COLORS = {"brick": (220, 30, 30), "book": (30, 40, 220), "leaf": (60, 200, 60)}


def write_frame(directory: Path, objects: dict[int, str], seed: int = 0) -> Path:
    """Write a labelled frame with a rectangle for each object; each name has its colour and size."""
    rng = np.random.default_rng(seed)
    color = rng.integers(100, 120, (240, 320, 3), np.uint8)
    mask = np.zeros((240, 320), np.uint8)
    for place, (label, name) in enumerate(objects.items()):
        window = slice(30, 140 if name == "brick" else 90), slice(20 + 100 * place, 100 + 100 * place)
        mask[window] = label
        color[window] = np.clip(np.array(FRAME_COLORS[name]) + rng.integers(-9, 10, (*mask[window].shape, 3)), 0, 255)
    return write_frame_files(directory, dataclasses.replace(tilted(mask), color=color), objects)


def instance_clouds(frame: thor2.RGBDFrame) -> list[PreparedInstance]:
    """Return the clouds of all instances in the order of `frame.instances`, including those that cannot be used."""
    return [instance_cloud(frame, label) for label in frame.instances]
