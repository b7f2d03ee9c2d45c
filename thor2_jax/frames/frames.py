"""RGB-D frames with an instance segmentation, which are validated at construction and can be read from image files.

    frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")
    frame.instances                        # label numbers; 0 is background
    points = backproject(frame.depth_m, frame.intrinsics)      # [H, W, 3] metres, OpenCV camera frame

Image files are not trusted. They are PNG, JPEG or TIFF; depth may also be NPY or EXR.
"""

import dataclasses
import io
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from thor2_jax.errors import InputError, as_array, decoding, needs_extra
from thor2_jax.files import as_path, open_file, read_npy
from thor2_jax.frames.intrinsics import Intrinsics, check_camera, read_intrinsics, undistort

__all__ = [
    "ImageSizeError",
    "Intrinsics",
    "MAX_DEPTH",
    "MAX_IMAGE_PIXELS",
    "MIN_DEPTH",
    "RGBDFrame",
    "RecordedFrame",
    "backproject",
    "check_frame",
    "check_size",
    "decode_image",
    "encode_image",
    "frame_intrinsics",
    "pixel_rays",
    "read_color",
    "read_depth",
    "read_frame",
    "read_labels",
]

MIN_DEPTH, MAX_DEPTH = 0.26, 2.5
"""Range of valid depth, metres."""

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF")
"""Image formats that are read. For some of its other formats, Pillow runs external programs."""

MAX_IMAGE_PIXELS = 2**26
"""Largest number of pixels of an image that is read: a small file can decompress to gigabytes."""

_EXPECTED = "one channel of 16-bit integers (in depth units) or floats (in metres)"
_DEPTH_FORMATS = "PNG or TIFF of 16-bit integers, TIFF of 32-bit floats, NPY or EXR"

_EXR_CHANNELS = ("Z", "Y", "R", "V", "depth")
"""Names of the depth channel in EXR files with several channels."""

MAX_INSTANCES = 1000
"""Largest number of instances of a frame; other images than labels, such as depth, have thousands of values."""


@dataclasses.dataclass(frozen=True, eq=False)
class RGBDFrame:
    """A registered RGB-D image and the instances in it.

    Attributes:
        color: [H, W, 3] uint8, sRGB.
        depth: [H, W] distance along the optical axis: unsigned integers in 1 / `intrinsics.depth_scale` metres
            (millimetres by default) or floats in metres. There is no depth where it is 0, not finite, or the largest
            value of an integer type or of float32.
        labels: [H, W] integers; 0 is background, every other number an instance. None for a frame that is not yet
            segmented: `thor2_jax.segmented` returns it with labels.
        intrinsics: the camera of all three images; a mapping, matrix or ROS message is converted by `Intrinsics.of`.

    Raises:
        InputError: a shape or type does not fit, or the intrinsics have another image size; the message names the
            argument.
    """

    color: NDArray[np.uint8]
    depth: NDArray[Any]
    labels: NDArray[Any] | None
    intrinsics: Intrinsics

    def __post_init__(self) -> None:
        color, depth = as_array(self.color, "color", "[H, W, 3]"), as_array(self.depth, "depth", "[H, W]")
        labels = None if self.labels is None else as_array(self.labels, "labels", "[H, W]")
        if color.ndim != 3 or color.shape[2] != 3 or 0 in color.shape:
            raise InputError(f"color has shape {color.shape}; expected [H, W, 3]")
        if color.dtype != np.uint8:
            raise InputError(f"color has type {color.dtype}; expected uint8")
        size = color.shape[:2]
        for name, image in (("depth", depth), ("labels", labels)):
            if image is not None and image.shape != size:
                raise InputError(f"{name} has shape {image.shape}; expected {size} (rows, columns), as color")
        if labels is not None and labels.dtype.kind not in "ui":
            raise InputError(f"labels has type {labels.dtype}; expected integers")
        if depth.dtype.kind not in "uf" or depth.dtype == np.uint8:
            raise InputError(
                f"depth has type {depth.dtype}; expected uint16 or uint32 (1 / depth_scale metres) or floats (metres)"
            )
        for value in () if labels is None else (labels.min(), labels.max()):
            if not 0 <= value < 2**63:
                raise InputError(f"labels has the value {value}; expected 0 to 2^63 - 1")
        intrinsics = Intrinsics.of(self.intrinsics)
        check_camera(intrinsics, *size)
        for name, value in (("color", color), ("depth", depth), ("labels", labels), ("intrinsics", intrinsics)):
            object.__setattr__(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without cached properties, to send the frame to another process."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @cached_property
    def depth_m(self) -> NDArray[np.float32]:
        """Depth in metres [H, W] float32; 0 where `depth` has none."""
        if self.depth.dtype.kind == "u":
            is_depth = self.depth != np.iinfo(self.depth.dtype).max
            return np.divide(self.depth, self.intrinsics.depth_scale, dtype=np.float32) * is_depth
        return np.where(np.abs(self.depth) < np.finfo(np.float32).max, self.depth, 0).astype(np.float32)

    @property
    def label_image(self) -> NDArray[Any]:
        """The labels [H, W] of a frame with labels.

        Raises:
            InputError: the frame has no labels.
        """
        if self.labels is None:
            raise InputError("labels is None; expected labels; give them, or segment the frame (--segment table)")
        return self.labels

    @cached_property
    def has_usable_depth(self) -> bool:
        """Whether any pixel of an instance has a depth from `MIN_DEPTH` to `MAX_DEPTH`; without instances, any pixel.

        Raises InputError as `label_image`.
        """
        counts = self.label_image != 0
        usable = (self.depth_m >= MIN_DEPTH) & (self.depth_m <= MAX_DEPTH)
        return bool((usable & counts if counts.any() else usable).any())

    @cached_property
    def instance_pixels(self) -> dict[int, NDArray[np.intp]]:
        """Label number -> sorted flat indices (row * W + column) of its pixels, in the order of `instances`.

        Raises:
            InputError: the frame has no labels, or more than `MAX_INSTANCES` instances.
        """
        flat = self.label_image.ravel()
        pixels = np.flatnonzero(flat != 0)  # much faster for booleans than for integers
        pixels = pixels[np.argsort(flat[pixels], kind="stable")]
        labels, first = np.unique(flat[pixels], return_index=True)
        if len(labels) > MAX_INSTANCES:
            raise InputError(
                f"labels has {len(labels)} instances; expected at most {MAX_INSTANCES}; give an image in which 0 is "
                "background and each object has a number of its own"
            )
        return dict(zip(labels.tolist(), np.split(pixels, first[1:]), strict=False))

    @cached_property
    def instances(self) -> tuple[int, ...]:
        """Label numbers of the frame without 0, in increasing order; raises InputError as `instance_pixels`."""
        return tuple(self.instance_pixels)

    def points(self, pixels: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the points [n, 3] of pixels (flat indices [n]) in metres; zeros where there is no depth.

        The frame is that of `backproject`.
        """
        return pixel_rays(pixels, self.depth.shape[1], self.intrinsics) * self.depth_m.ravel()[pixels, None]


def check_frame(frame: object) -> None:
    """Raise InputError unless the value is a frame."""
    if not isinstance(frame, RGBDFrame):
        raise InputError(f"frame is of type {type(frame).__name__}; expected an RGBDFrame, as read_frame returns it")


def pixel_rays(pixels: NDArray[np.intp], width: int, intrinsics: Intrinsics) -> NDArray[np.float64]:
    """Return the rays [n, 3] with z = 1 through pixels (flat indices [n]), in the OpenCV camera frame.

    A ray times the pixel's depth is its point.
    """
    row, column = np.divmod(pixels, width)
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (column - intrinsics.cx) / intrinsics.fx
    rays[:, 1] = (row - intrinsics.cy) / intrinsics.fy
    if intrinsics.distortion:
        rays[:, 0], rays[:, 1] = undistort(rays[:, 0], rays[:, 1], intrinsics.distortion)
    return rays


def backproject(depth_m: NDArray[Any], intrinsics: Intrinsics) -> NDArray[Any]:
    """Return the points [H, W, 3] of a depth image [H, W] in metres.

    The frame is OpenCV's camera frame (x right, y down, z forward). Points are computed in float64 and returned in the
    type of the depths.
    """
    rays = pixel_rays(np.arange(depth_m.size), depth_m.shape[1], intrinsics).reshape(*depth_m.shape, 3)
    return (rays * depth_m[..., None]).astype(depth_m.dtype)


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
        Exception: of any type, if the image is damaged, not in `formats`, a TIFF of several pages or with another
            orientation than 1, or, with `lossless`, has JPEG compression.
    """
    try:
        opened = Image.open(stream, formats=formats)
    except UnidentifiedImageError:  # whose message contains the Python object of the stream
        raise ValueError("its first bytes are not those of an expected format") from None
    with opened as image:
        check_size(*image.size, max_pixels)
        if lossless and "JPEG" in (image.format, str(image.info.get("compression")).upper()):
            raise ValueError("JPEG compression changes label numbers")
        # 274 is the orientation, by which Pillow turns a TIFF, unlike the other formats.
        if image.format == "TIFF" and (getattr(image, "is_animated", False) or image.getexif().get(274, 1) != 1):
            raise ValueError("it has several pages or is turned; save it as one page with orientation 1")
        image.verify()  # decoding does not check the checksums of a PNG
    stream.seek(0)
    with Image.open(stream, formats=formats) as image:
        # Pillow decodes 16 bits as 8 if a TIFF has them in one plane for each channel; the tiles do not show this.
        bits = getattr(image, "tag_v2", {}).get(258, ())
        is_deep = image.mode.startswith("RGB") and (16 in bits or any(";16" in str(tile.args) for tile in image.tile))
        return np.asarray(image), f"{image.mode};16" if is_deep else image.mode


def encode_image(image: NDArray[Any] | Image.Image, kind: str = "PNG", **options: Any) -> bytes:
    """Return the content of an image file with these pixels; the options are those of Pillow."""
    stream = io.BytesIO()
    (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(stream, kind, **options)
    return stream.getvalue()


def read_image(path: str | Path, argument: str, expected: str, lossless: bool = False) -> tuple[NDArray[Any], str]:
    """Read an image file with `decode_image`; messages say that the formats `expected` are expected.

    Raises:
        InputError: the file is damaged, not in `IMAGE_FORMATS`, larger than `MAX_IMAGE_PIXELS` or, with `lossless`, has
            JPEG compression; the message names `argument` and the file.
        OSError: the file cannot be opened.
    """
    path = as_path(path, argument)
    with open_file(path) as stream, decoding(f"{argument}: {path} cannot be read as an image", expected):
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
    path = as_path(path, "depth")
    suffix = path.suffix.lower()
    if suffix == ".npy":
        with open_file(path) as stream, decoding(f"depth: {path} is a damaged NPY file", _EXPECTED):
            pixels = read_npy(stream, 8 * MAX_IMAGE_PIXELS)
    else:
        pixels = _read_exr(path) if suffix == ".exr" else read_image(path, "depth", _DEPTH_FORMATS)[0]
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[..., 0]
    if pixels.ndim != 2 or 0 in pixels.shape or pixels.dtype.kind not in "uif" or pixels.dtype.itemsize < 2:
        raise InputError(
            f"depth: {path} has shape {pixels.shape} and type {pixels.dtype}; expected {_EXPECTED}, not a picture of "
            "depth"
        )
    if pixels.dtype.kind == "f":
        return pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    # Pillow reads some 16-bit files as 32-bit integers.
    largest = 2**32 - 1 if suffix == ".npy" else 2**16 - 1
    if pixels.min() < 0 or pixels.max() > largest:
        raise InputError(f"depth: {path} has values from {pixels.min()} to {pixels.max()}; expected 0 to {largest}")
    return pixels.astype(np.uint16 if pixels.max() < 2**16 else np.uint32)


def _read_exr(path: Path) -> NDArray[Any]:
    """Read the depth channel of an EXR file."""
    open_file(path).close()  # raises OSError if it cannot be opened, unlike OpenEXR
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


def read_color(path: str | Path) -> NDArray[np.uint8]:
    """Read an 8-bit RGB image [H, W, 3] without its alpha channel; raise errors as `read_frame`."""
    pixels, mode = read_image(path, "color", "PNG, JPEG or TIFF")
    if mode not in ("RGB", "RGBA"):
        raise InputError(f"color: {path} has the mode {mode}; expected 8-bit RGB")
    return np.ascontiguousarray(pixels[..., :3])


def read_labels(path: str | Path) -> NDArray[Any]:
    """Read a one-channel or indexed image [H, W] of integers; raise errors as `read_frame`."""
    pixels, _ = read_image(path, "labels", "PNG or TIFF without JPEG compression", lossless=True)
    if pixels.ndim != 2 or pixels.dtype.kind not in "ui":
        raise InputError(
            f"labels: {path} has shape {pixels.shape} and type {pixels.dtype}; expected one channel of integers"
        )
    return pixels


def read_frame(
    *,
    color: str | Path,
    depth: str | Path,
    labels: str | Path | None = None,
    intrinsics: str | Path,
    depth_scale: float | None = None,
) -> RGBDFrame:
    """Read a frame from files; docs/frames.md describes the formats.

    Args:
        color: 8-bit RGB image (PNG, JPEG or TIFF; an alpha channel is dropped).
        depth: one-channel image, see `read_depth`.
        labels: one-channel or indexed image of instance numbers, 8 or 16 bits, lossless; 0 is background.
            None for a frame without labels.
        intrinsics: file in a format of `thor2_jax.frames.intrinsics`. From a BOP scene_camera.json, the entry whose
            image number is the name of `color` is read.
        depth_scale: depth units per metre, in place of the value in `intrinsics`.

    Raises:
        InputError: a file is damaged or of the wrong kind, or the images differ in size; the message names the
            file or the argument.
        OSError: a file cannot be opened.
    """
    label_image = None if labels is None else read_labels(labels)
    camera = frame_intrinsics(intrinsics, color, depth_scale)
    return RGBDFrame(read_color(color), read_depth(depth), label_image, camera)


def frame_intrinsics(path: str | Path, color: str | Path, depth_scale: float | None = None) -> Intrinsics:
    """Read the intrinsics of the frame with this colour file; arguments and exceptions as `read_frame`."""
    name = as_path(color, "color").stem
    return read_intrinsics(path, int(name) if name.isdecimal() else None).with_depth_scale(depth_scale)


@dataclasses.dataclass(frozen=True)
class RecordedFrame:
    """A frame that is read on demand.

    Attributes:
        name: unique name: time stamp in seconds, with a number if several frames share it, or name of the folder.
        read: function that returns the frame, without labels in recordings; raises InputError and OSError.
        stamp: time of the colour image, nanoseconds.
        gap: time from the colour image to the depth image, nanoseconds.
        frame_id: coordinate frame of the colour camera in ROS.
    """

    name: str
    read: Callable[[], RGBDFrame]
    stamp: int
    gap: int = 0
    frame_id: str = ""
