"""Reading of untrusted image files: PNG, JPEG and TIFF, for depth also NPY and EXR."""

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.errors import InputError, decoding, needs_extra
from thor2_jax.files import open_file

__all__ = ["MAX_IMAGE_PIXELS", "ImageSizeError", "check_size", "decode_image", "read_depth", "read_image", "read_npy"]

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF")
"""Image formats that are read. For some of its other formats, Pillow runs external programs."""

MAX_IMAGE_PIXELS = 2**26
"""Largest number of pixels of an image that is read: a small file can decompress to gigabytes."""

_EXPECTED = "one channel of 16-bit integers (in depth units) or floats (in metres)"

_EXR_CHANNELS = ("Z", "Y", "R", "V", "depth")
"""Names of the depth channel in EXR files with several channels."""


class ImageSizeError(ValueError):
    """Error of an image that has no pixels or too many."""


def check_size(width: int, height: int, max_pixels: int = MAX_IMAGE_PIXELS) -> None:
    """Raise ImageSizeError unless an image has 1 to `max_pixels` pixels."""
    if not 0 < width * height <= max_pixels:
        raise ImageSizeError(f"{width} x {height} pixels; expected at most {max_pixels}")


def decode_image(
    stream: BinaryIO,
    formats: tuple[str, ...] = IMAGE_FORMATS,
    max_pixels: int = MAX_IMAGE_PIXELS,
    lossless: bool = False,
) -> tuple[NDArray[Any], str]:
    """Decode an image; return its pixels and its Pillow mode, with ";16" for colour of 16 bits per channel.

    Pillow keeps 8 of these 16 bits.

    Raises:
        ImageSizeError: the image has more than `max_pixels` pixels.
        Exception: of any type, if the image is damaged, not in `formats` or, with `lossless`, has JPEG compression.
    """
    with Image.open(stream, formats=formats) as image:
        check_size(*image.size, max_pixels)
        if lossless and "JPEG" in (image.format, str(image.info.get("compression")).upper()):
            raise ValueError("JPEG compression changes label numbers")
        image.verify()  # decoding does not check the checksums of a PNG
    stream.seek(0)
    with Image.open(stream, formats=formats) as image:
        is_deep = image.mode.startswith("RGB") and any(";16" in str(tile.args) for tile in image.tile)
        return np.asarray(image), f"{image.mode};16" if is_deep else image.mode


def read_image(path: str | Path, argument: str, lossless: bool = False) -> tuple[NDArray[Any], str]:
    """Read an image file with `decode_image`.

    Raises:
        InputError: the file is damaged, not in `IMAGE_FORMATS`, larger than `MAX_IMAGE_PIXELS` or, with `lossless`, has
            JPEG compression; the message names `argument` and the file.
        OSError: the file cannot be opened.
    """
    expected = "PNG or TIFF without JPEG compression" if lossless else ", ".join(IMAGE_FORMATS)
    with open_file(path) as stream, decoding(f"{argument}: {path} is damaged or no image", expected):
        return decode_image(stream, lossless=lossless)


def read_depth(path: str | Path) -> NDArray[Any]:
    """Read a depth image [H, W].

    Returns:
        uint16 in depth units from a 16-bit PNG or TIFF, uint16 or uint32 from integers in NPY, and floats in metres
        from a float TIFF, NPY or EXR.

    Raises:
        InputError: the file is damaged, of another kind or too large, or is an EXR file and the package OpenEXR is
            missing; the message names the file.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        with open_file(path) as stream, decoding(f"depth: {path} is a damaged NPY file", _EXPECTED):
            pixels = read_npy(stream, 8 * MAX_IMAGE_PIXELS)
    else:
        pixels = _read_exr(path) if suffix == ".exr" else read_image(path, "depth")[0]
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    kind, size = pixels.dtype.kind, pixels.dtype.itemsize
    if pixels.ndim != 2 or 0 in pixels.shape or kind not in "uif" or (kind != "f" and size < 2):
        raise InputError(
            f"depth: {path} has shape {pixels.shape} and type {pixels.dtype}; expected {_EXPECTED}, not a picture of "
            "depth"
        )
    if kind == "f":
        return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    # Pillow reads some 16-bit files as 32-bit integers.
    largest = 2**32 - 1 if suffix == ".npy" else 2**16 - 1
    if pixels.min() < 0 or pixels.max() > largest:
        raise InputError(f"depth: {path} has values from {pixels.min()} to {pixels.max()}; expected 0 to {largest}")
    return pixels.astype(np.uint16 if pixels.max() < 2**16 else np.uint32)


def read_npy(stream: BinaryIO, max_bytes: int) -> NDArray[Any]:
    """Read an array from an NPY file; its size is checked before memory is allocated, and nothing is unpickled.

    Raises:
        Exception: of any type, if the file is damaged, contains Python objects or more than `max_bytes` of values.
    """
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = read_header[version](stream)
    if math.prod(shape) * max(dtype.itemsize, 1) > max_bytes:  # also rejects values without bytes (type V0)
        raise ValueError(f"shape {shape} of {dtype}; expected at most {max_bytes} bytes")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _read_exr(path: Path) -> NDArray[Any]:
    """Read the depth channel of an EXR file."""
    with open_file(path):  # raises OSError if it cannot be opened, unlike OpenEXR
        pass
    with needs_extra(f"depth: {path} is an EXR file; expected PNG, TIFF or NPY; EXR", "OpenEXR", "exr"):
        import OpenEXR
    with decoding(f"depth: {path} is a damaged EXR file", _EXPECTED):
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as header:
            low, high = header.header()["dataWindow"]
        check_size(*(int(b) - int(a) + 1 for a, b in zip(low, high, strict=True)))
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    names = [*channels] if len(channels) == 1 else [name for name in _EXR_CHANNELS if name in channels]
    if not names:
        raise InputError(f"depth: {path} has the channels {', '.join(channels)}; expected one, or one of them called Z")
    return channels[names[0]]
