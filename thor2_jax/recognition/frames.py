"""RGB-D frames with an instance segmentation: checked on construction, read from image files.

frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")
frame.instances                        # label numbers, 0 is background
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
from PIL import Image

from thor2_jax.errors import InputError, with_context

__all__ = [
    "MOST_PIXELS",
    "Intrinsics",
    "RGBDFrame",
    "backproject",
    "pixel_rays",
    "read_color",
    "read_depth",
    "read_frame",
    "read_intrinsics",
    "read_labels",
]


FORMATS = ("PNG", "JPEG", "TIFF")
"""Of images that are read. Some of the others that Pillow knows run programs."""

MOST_PIXELS = 2**26
"""Of an image that is read: a small file can tell of a large one, and fill memory."""


LARGEST = 10**9
"""Of a number of the intrinsics, in size: past it, it is none of a camera, and integers soon fit no array."""


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and abs(float(value)) <= LARGEST
    except OverflowError:  # an integer past the largest float
        return False


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion; pixel centres have integer coordinates.

    Attributes:
        fx: focal length in pixels along a row.
        fy: focal length in pixels along a column.
        cx: principal point, column.
        cy: principal point, row.
        depth_scale: depth units a metre (1000: millimetres).

    Raises:
        InputError: a value that is no finite number or past `LARGEST`, or a focal length or depth scale that is not
            positive.
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
                    f"intrinsics.{field.name} is {value!r}; it must be a finite number, at most {LARGEST:.0e} in size"
                )
            if value <= 0 and field.name not in ("cx", "cy"):
                raise InputError(f"intrinsics.{field.name} is {value!r}; it must be positive")

    @classmethod
    def of(cls, values: Any) -> "Intrinsics":
        """From a mapping with fx, fy, cx, cy and, if it is there, depth_scale; other entries are passed over.

        Raises:
            InputError: no mapping, a missing entry, or a value that `Intrinsics` refuses.
        """
        if not isinstance(values, Mapping):
            raise InputError(f"intrinsics is a {type(values).__name__}; expected a table with fx, fy, cx, cy")
        missing = [name for name in ("fx", "fy", "cx", "cy") if name not in values]
        if missing:
            raise InputError(f"intrinsics lacks {', '.join(missing)}")
        return cls(**{f.name: values[f.name] for f in dataclasses.fields(cls) if f.name in values})


@dataclasses.dataclass(frozen=True, eq=False)
class RGBDFrame:
    """One registered RGB-D image and the instances in it.

    Attributes:
        color: [H, W, 3] uint8, sRGB.
        depth: [H, W] unsigned integers in 1 / `intrinsics.depth_scale` metres, or floats in metres; 0 (or not finite)
            where there is none.
        labels: [H, W] integers, at least 0; 0 is background, every other number an instance.
        intrinsics: of the common pixel grid; a mapping (see `Intrinsics.of`) is taken as well.

    Raises:
        InputError: shapes or types that do not fit, naming the argument and what it is.
    """

    color: NDArray[np.uint8]
    depth: NDArray[Any]
    labels: NDArray[Any]
    intrinsics: Intrinsics

    def __post_init__(self) -> None:
        color, depth, labels = (np.asarray(getattr(self, name)) for name in ("color", "depth", "labels"))
        if color.ndim != 3 or color.shape[2] != 3 or 0 in color.shape:
            raise InputError(f"color has shape {color.shape}; expected [H, W, 3]")
        if color.dtype != np.uint8:
            raise InputError(f"color has type {color.dtype}; expected uint8")
        for name, image in (("depth", depth), ("labels", labels)):
            if image.shape != color.shape[:2]:
                raise InputError(f"{name} has shape {image.shape}; color has {color.shape[:2]} (rows, columns)")
        if depth.dtype.kind not in "uf" or depth.dtype == np.uint8:
            raise InputError(
                f"depth has type {depth.dtype}; expected uint16 or uint32 (1 / depth_scale metres) or floats (metres)"
            )
        if labels.dtype.kind not in "ui":
            raise InputError(f"labels has type {labels.dtype}; expected integers")
        if labels.min() < 0:
            raise InputError(f"labels has the value {labels.min()}; labels must be at least 0")
        given = self.intrinsics
        intrinsics = given if isinstance(given, Intrinsics) else Intrinsics.of(given)
        for name, value in (("color", color), ("depth", depth), ("labels", labels), ("intrinsics", intrinsics)):
            object.__setattr__(self, name, value)

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        """Depth [H, W] float32 in metres; 0 where there is none."""
        if self.depth.dtype.kind == "u":
            return np.divide(self.depth, self.intrinsics.depth_scale, dtype=np.float32)
        return np.where(np.isfinite(self.depth), self.depth, 0).astype(np.float32)

    @cached_property
    def instance_pixels(self) -> dict[int, NDArray[np.intp]]:
        """Label number -> its pixels, sorted flat indices (row * W + column); labels in increasing order, without 0."""
        flat = self.labels.ravel()
        pixels = np.flatnonzero(flat != 0)  # of booleans: several times as fast
        order = np.argsort(flat[pixels], kind="stable")
        pixels = pixels[order]
        found, first = np.unique(flat[pixels], return_index=True)
        return dict(zip(found.tolist(), np.split(pixels, first[1:]), strict=False))

    @cached_property
    def instances(self) -> tuple[int, ...]:
        """Label numbers that occur, in increasing order, without 0."""
        return tuple(self.instance_pixels)


def pixel_rays(pixels: NDArray[np.intp], width: int, intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Rays [n, 3] through pixels (flat indices [n]) in the OpenCV camera frame, z = 1: times a depth, a point."""
    row, column = np.divmod(pixels, width)
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (column - intrinsics.cx) / intrinsics.fx
    rays[:, 1] = (row - intrinsics.cy) / intrinsics.fy
    return rays


def backproject(depth_m: NDArray[Any], intrinsics: Intrinsics) -> NDArray[Any]:
    """Points [H, W, 3] of a depth image [H, W], metres, in the OpenCV camera frame (x right, y down, z forward)."""
    height, width = depth_m.shape
    rays = pixel_rays(np.arange(height * width), width, intrinsics)
    return (rays * depth_m.reshape(-1, 1)).astype(depth_m.dtype).reshape(height, width, 3)


def _read_image(path: str | Path, argument: str) -> tuple[NDArray[Any], str]:
    """An image file as an array, and its mode, Pillow's word for what the numbers mean.

    Raises:
        InputError: none of `FORMATS`, damaged, or of more than `MOST_PIXELS`; names `argument` and the file.
        OSError: it cannot be opened.
    """
    with open(path, "rb") as stream:
        try:
            with Image.open(stream, formats=FORMATS) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise ValueError(f"{image.width} x {image.height} pixels; at most {MOST_PIXELS} are read")
                image.verify()  # decoding passes over the checksums of a PNG's pixels
            stream.seek(0)
            with Image.open(stream, formats=FORMATS) as image:
                return np.asarray(image), image.mode
        # Damaged files make the decoders raise a dozen kinds of exception; only bytes are at work here.
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{argument}: {path} is damaged or no image ({reason})") from None


def read_color(path: str | Path) -> NDArray[np.uint8]:
    """Read an 8-bit RGB image [H, W, 3]; an alpha channel is dropped. Raises InputError and OSError as `read_frame`."""
    found, mode = _read_image(path, "color")
    if mode not in ("RGB", "RGBA"):
        raise InputError(f"color: {path} has the mode {mode}; expected 8-bit RGB")
    return np.ascontiguousarray(found[..., :3])


def read_depth(path: str | Path) -> NDArray[np.uint16]:
    """Read a one-channel 16-bit image [H, W]. Raises InputError and OSError as `read_frame`."""
    found, _ = _read_image(path, "depth")
    if found.ndim != 2 or found.dtype not in (np.uint16, np.int32):
        raise InputError(
            f"depth: {path} has shape {found.shape} and type {found.dtype}; expected one channel of 16 bits"
        )
    # Pillow reads some 16-bit files as 32-bit integers.
    if found.dtype == np.int32 and (found.min() < 0 or found.max() > 65535):
        raise InputError(f"depth: {path} has values from {found.min()} to {found.max()}; expected 0 to 65535")
    return found.astype(np.uint16)


def read_labels(path: str | Path) -> NDArray[Any]:
    """Read a one-channel or indexed image [H, W] of whole numbers. Raises InputError and OSError as `read_frame`."""
    found, _ = _read_image(path, "labels")
    if found.ndim != 2 or found.dtype.kind not in "ui":
        raise InputError(
            f"labels: {path} has shape {found.shape} and type {found.dtype}; expected one channel of whole numbers"
        )
    return found


def read_intrinsics(path: str | Path) -> Intrinsics:
    """Read intrinsics from a JSON file: fx, fy, cx, cy and, if it is there, depth_scale (units a metre).

    Raises:
        InputError: no JSON, or not these numbers; names the file.
        OSError: it cannot be opened.
    """
    try:
        values = json.loads(Path(path).read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"intrinsics: {path} is no JSON ({error})") from None
    with with_context(str(path)):
        return Intrinsics.of(values)


def read_frame(*, color: str | Path, depth: str | Path, labels: str | Path, intrinsics: str | Path) -> RGBDFrame:
    """Read a frame from files.

    Args:
        color: 8-bit RGB image (PNG or JPEG; an alpha channel is dropped).
        depth: 16-bit one-channel PNG in 1 / depth_scale metres.
        labels: one-channel or indexed PNG of instance numbers, 8 or 16 bits.
        intrinsics: JSON, see `read_intrinsics`.

    Raises:
        InputError: a file that is damaged or of another kind, or images of different sizes; names the file or the
            argument.
        OSError: a file cannot be opened.
    """
    return RGBDFrame(read_color(color), read_depth(depth), read_labels(labels), read_intrinsics(intrinsics))
