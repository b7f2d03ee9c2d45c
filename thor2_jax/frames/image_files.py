"""Reading of PNG, JPEG and TIFF files whose content is not trusted."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFile

from thor2_jax.errors import InputError

__all__ = ["MAX_IMAGE_PIXELS", "has_16_bit_channels", "read_image"]

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF")
"""Image formats that are read. For some of its other formats, Pillow runs external programs."""

MAX_IMAGE_PIXELS = 2**26
"""Largest number of pixels of an image that is read: a small file can decompress to gigabytes."""


def has_16_bit_channels(image: ImageFile.ImageFile) -> bool:
    """Return whether a newly opened colour image has 16 bits per channel, of which Pillow keeps 8."""
    return image.mode.startswith("RGB") and any(";16" in str(tile.args) for tile in image.tile)


def read_image(path: str | Path, argument: str, lossless: bool = False) -> tuple[NDArray[Any], str]:
    """Read an image file; return its pixels and its Pillow mode, with ";16" for colour of 16 bits per channel.

    Raises:
        InputError: the file is damaged, not of `IMAGE_FORMATS`, larger than `MAX_IMAGE_PIXELS` or, with `lossless`, has
            JPEG compression; names `argument` and the file.
        OSError: the file cannot be opened.
    """
    expected = "PNG or TIFF without JPEG compression" if lossless else ", ".join(IMAGE_FORMATS)
    with open(path, "rb") as stream:
        try:
            with Image.open(stream, formats=IMAGE_FORMATS) as image:
                if image.width * image.height > MAX_IMAGE_PIXELS:
                    raise ValueError(f"{image.width} x {image.height} pixels; expected at most {MAX_IMAGE_PIXELS}")
                if lossless and "JPEG" in (image.format, str(image.info.get("compression")).upper()):
                    raise ValueError("JPEG compression changes label numbers")
                image.verify()  # decoding does not check the checksums of a PNG
            stream.seek(0)
            with Image.open(stream, formats=IMAGE_FORMATS) as image:
                mode = f"{image.mode};16" if has_16_bit_channels(image) else image.mode
                return np.asarray(image), mode
        # On damaged files, the decoders raise many kinds of exception; nothing but the content can cause them here.
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{argument}: {path} is damaged or no image ({reason}); expected {expected}") from None
