"""RGB-D frames with an instance segmentation: validated when they are made, read from image files.

frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")
frame.instances                        # label numbers; 0 is background
points = backproject(frame.depth_m, frame.intrinsics)      # [H, W, 3] metres, OpenCV camera frame
"""

import dataclasses
import json
from collections.abc import Mapping
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageFile

from thor2_jax.errors import InputError, with_context

__all__ = [
    "MAX_IMAGE_PIXELS",
    "Intrinsics",
    "RGBDFrame",
    "backproject",
    "has_16_bit_channels",
    "parse_intrinsics",
    "pixel_rays",
    "read_color",
    "read_depth",
    "read_frame",
    "read_intrinsics",
    "read_labels",
]


IMAGE_FORMATS = ("PNG", "JPEG", "TIFF")
"""Image formats that are read. For some of its other formats, Pillow runs external programs."""

MAX_IMAGE_PIXELS = 2**26
"""Largest number of pixels of an image that is read: a small file can decompress to gigabytes."""

LARGEST_INTRINSIC = 10**9
"""Largest absolute value accepted for an intrinsic parameter."""


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and abs(float(value)) <= LARGEST_INTRINSIC
    except OverflowError:  # an integer past the largest float
        return False


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; pixel centres have integer coordinates.

    Attributes:
        fx: focal length along a row, pixels.
        fy: focal length along a column, pixels.
        cx: column of the principal point.
        cy: row of the principal point.
        depth_scale: depth units per metre; 1000 if depth is in millimetres.

    Raises:
        InputError: a value is not a finite number or exceeds `LARGEST_INTRINSIC`, or a focal length or the depth scale
            is not positive.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: float = 1000.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not _is_number(value):
                raise InputError(
                    f"intrinsics.{field.name} is {value!r}; expected a finite number of at most {LARGEST_INTRINSIC:.0e}"
                )
            if value <= 0 and field.name not in ("cx", "cy"):
                raise InputError(f"intrinsics.{field.name} is {value!r}; expected a positive number")

    @classmethod
    def of(cls, values: Any) -> "Intrinsics":
        """Make intrinsics from a mapping with fx, fy, cx, cy and optionally depth_scale; other entries are ignored.

        Raises:
            InputError: `values` is not a mapping, lacks an entry or has an invalid one.
        """
        if not isinstance(values, Mapping):
            raise InputError(f"intrinsics is a {type(values).__name__}; expected a mapping with fx, fy, cx, cy")
        missing = [name for name in ("fx", "fy", "cx", "cy") if name not in values]
        if missing:
            raise InputError(f"intrinsics lacks {', '.join(missing)}; expected fx, fy, cx, cy")
        return cls(**{f.name: values[f.name] for f in dataclasses.fields(cls) if f.name in values})

    @classmethod
    def of_matrix(cls, matrix: Any, depth_scale: float = 1000.0) -> "Intrinsics":
        """Make intrinsics from the nine numbers of a camera matrix, row by row.

        Raises:
            InputError: `matrix` is not of the form fx, 0, cx, 0, fy, cy, 0, 0, 1, or a value is invalid.
        """
        try:
            fx, skew, cx, a, fy, cy, b, c, one = matrix
        except (TypeError, ValueError):
            skew = None
        if skew is None or [skew, a, b, c, one] != [0, 0, 0, 0, 1]:
            raise InputError(f"intrinsics is {matrix!r}; expected fx, 0, cx, 0, fy, cy, 0, 0, 1")
        return cls.of({"fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": depth_scale})


@dataclasses.dataclass(frozen=True, eq=False)
class RGBDFrame:
    """A registered RGB-D image and the instances in it.

    Attributes:
        color: [H, W, 3] uint8, sRGB.
        depth: [H, W] distance along the optical axis: unsigned integers in 1 / `intrinsics.depth_scale` metres
            (millimetres by default) or floats in metres; 0, and in floats also NaN or infinity, where there is none.
        labels: [H, W] integers; 0 is background, every other number an instance. None for a frame that is not yet
            segmented: `thor2_jax.segmentation.segmented` returns it with labels.
        intrinsics: the camera of all three images; a mapping is converted by `Intrinsics.of`.

    Raises:
        InputError: a shape or type that does not fit; names the argument.
    """

    color: NDArray[np.uint8]
    depth: NDArray[Any]
    labels: NDArray[Any] | None
    intrinsics: Intrinsics

    def __post_init__(self) -> None:
        color, depth = np.asarray(self.color), np.asarray(self.depth)
        labels = None if self.labels is None else np.asarray(self.labels)
        if color.ndim != 3 or color.shape[2] != 3 or 0 in color.shape:
            raise InputError(f"color has shape {color.shape}; expected [H, W, 3]")
        if color.dtype != np.uint8:
            raise InputError(f"color has type {color.dtype}; expected uint8")
        for name, image in (("depth", depth), ("labels", labels)):
            if image is not None and image.shape != color.shape[:2]:
                raise InputError(
                    f"{name} has shape {image.shape}; expected {color.shape[:2]} (rows, columns), as color"
                )
        if depth.dtype.kind not in "uf" or depth.dtype == np.uint8:
            raise InputError(
                f"depth has type {depth.dtype}; expected uint16 or uint32 (1 / depth_scale metres) or floats (metres)"
            )
        if labels is not None and labels.dtype.kind not in "ui":
            raise InputError(f"labels has type {labels.dtype}; expected integers")
        if labels is not None and labels.min() < 0:
            raise InputError(f"labels has the value {labels.min()}; expected 0 or more")
        camera = self.intrinsics
        intrinsics = camera if isinstance(camera, Intrinsics) else Intrinsics.of(camera)
        for name, value in (("color", color), ("depth", depth), ("labels", labels), ("intrinsics", intrinsics)):
            object.__setattr__(self, name, value)

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        """Depth in metres [H, W] float32; 0 where there is none."""
        if self.depth.dtype.kind == "u":
            return np.divide(self.depth, self.intrinsics.depth_scale, dtype=np.float32)
        return np.where(np.isfinite(self.depth), self.depth, 0).astype(np.float32)

    @property
    def label_image(self) -> NDArray[Any]:
        """`labels` of a frame that has them.

        Raises:
            InputError: the frame has no labels.
        """
        if self.labels is None:
            raise InputError("labels is None; expected an image of instance numbers: give labels, or segment the frame")
        return self.labels

    @cached_property
    def instance_pixels(self) -> dict[int, NDArray[np.intp]]:
        """Label number -> sorted flat indices (row * W + column) of its pixels, in the order of `instances`.

        Raises InputError as `label_image`.
        """
        flat = self.label_image.ravel()
        pixels = np.flatnonzero(flat != 0)  # several times as fast on booleans as on integers
        order = np.argsort(flat[pixels], kind="stable")
        pixels = pixels[order]
        labels, first = np.unique(flat[pixels], return_index=True)
        return dict(zip(labels.tolist(), np.split(pixels, first[1:]), strict=False))

    @cached_property
    def instances(self) -> tuple[int, ...]:
        """Label numbers of the frame in increasing order, without 0; raises InputError as `label_image`."""
        return tuple(self.instance_pixels)


def pixel_rays(pixels: NDArray[np.intp], width: int, intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Return the rays [n, 3] with z = 1 through pixels (flat indices [n]), in the OpenCV camera frame.

    A ray times the pixel's depth is its point.
    """
    row, column = np.divmod(pixels, width)
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (column - intrinsics.cx) / intrinsics.fx
    rays[:, 1] = (row - intrinsics.cy) / intrinsics.fy
    return rays


def backproject(depth_m: NDArray[Any], intrinsics: Intrinsics) -> NDArray[Any]:
    """Return the points [H, W, 3] of a depth image [H, W] in metres.

    The frame is OpenCV's camera frame (x right, y down, z forward).
    """
    height, width = depth_m.shape
    rays = pixel_rays(np.arange(height * width), width, intrinsics)
    return (rays * depth_m.reshape(-1, 1)).astype(depth_m.dtype).reshape(height, width, 3)


def has_16_bit_channels(image: ImageFile.ImageFile) -> bool:
    """Return whether a newly opened colour image has 16 bits per channel, of which Pillow keeps 8."""
    return image.mode.startswith("RGB") and any(";16" in str(tile.args) for tile in image.tile)


def _read_image(path: str | Path, argument: str, lossless: bool = False) -> tuple[NDArray[Any], str]:
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


def read_color(path: str | Path) -> NDArray[np.uint8]:
    """Read an 8-bit RGB image [H, W, 3]; an alpha channel is dropped. Raises InputError and OSError as `read_frame`."""
    pixels, mode = _read_image(path, "color")
    if mode not in ("RGB", "RGBA"):
        raise InputError(f"color: {path} has the mode {mode}; expected 8-bit RGB")
    return np.ascontiguousarray(pixels[..., :3])


def read_depth(path: str | Path) -> NDArray[np.uint16]:
    """Read a one-channel 16-bit image [H, W]. Raises InputError and OSError as `read_frame`."""
    pixels, _ = _read_image(path, "depth")
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.int32):
        raise InputError(
            f"depth: {path} has shape {pixels.shape} and type {pixels.dtype}; expected one channel of 16 bits"
        )
    # Pillow reads some 16-bit files as 32-bit integers.
    if pixels.dtype == np.int32 and (pixels.min() < 0 or pixels.max() > 65535):
        raise InputError(f"depth: {path} has values from {pixels.min()} to {pixels.max()}; expected 0 to 65535")
    return pixels.astype(np.uint16)


def read_labels(path: str | Path) -> NDArray[Any]:
    """Read a one-channel or indexed image [H, W] of integers. Raises InputError and OSError as `read_frame`."""
    pixels, _ = _read_image(path, "labels", lossless=True)
    if pixels.ndim != 2 or pixels.dtype.kind not in "ui":
        raise InputError(
            f"labels: {path} has shape {pixels.shape} and type {pixels.dtype}; expected one channel of integers"
        )
    return pixels


def parse_intrinsics(content: bytes) -> Intrinsics:
    """Make intrinsics from JSON text: an object with fx, fy, cx, cy and optionally depth_scale (depth units per metre).

    Raises:
        InputError: `content` is not valid JSON, or as `Intrinsics.of`.
    """
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        reason = {UnicodeDecodeError: "not UTF-8", RecursionError: "nested too deeply"}.get(type(error), error)
        raise InputError(f"intrinsics is not valid JSON ({reason}); expected an object with fx, fy, cx, cy") from None
    return Intrinsics.of(values)


def read_intrinsics(path: str | Path) -> Intrinsics:
    """Read intrinsics from a JSON file, see `parse_intrinsics`.

    Raises:
        InputError: as `parse_intrinsics`; names the file.
        OSError: the file cannot be opened.
    """
    content = Path(path).read_bytes()
    with with_context(str(path)):
        return parse_intrinsics(content)


def read_frame(
    *, color: str | Path, depth: str | Path, labels: str | Path | None = None, intrinsics: str | Path
) -> RGBDFrame:
    """Read a frame from files.

    Args:
        color: 8-bit RGB image (PNG, JPEG or TIFF; an alpha channel is dropped).
        depth: 16-bit one-channel image in 1 / depth_scale metres, by default millimetres.
        labels: one-channel or indexed image of instance numbers, 8 or 16 bits, lossless; 0 is background.
            None for a frame without labels.
        intrinsics: JSON file, see `parse_intrinsics`.

    Raises:
        InputError: a file is damaged or of the wrong kind, or the images differ in size; names the file or
            the argument.
        OSError: a file cannot be opened.
    """
    label_image = None if labels is None else read_labels(labels)
    return RGBDFrame(read_color(color), read_depth(depth), label_image, read_intrinsics(intrinsics))
