"""ROS messages: Image and CompressedImage to arrays, CameraInfo to intrinsics, detections to a Detection2DArray.

The functions read attributes only, so they accept messages of ROS 1, ROS 2 (rclpy) and rosbags.
"""

import io
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.errors import InputError, decoding
from thor2_jax.frames.frames import MAX_IMAGE_PIXELS, decode_image
from thor2_jax.frames.intrinsics import Intrinsics
from thor2_jax.model.recognition import Detection

__all__ = [
    "camera_of",
    "color_image",
    "depth_image",
    "detection_array",
    "image_kind",
    "ros_time",
    "stamp_name",
    "stamp_of",
]

_COLOR_CHANNELS = {"rgb8": "rgb", "bgr8": "bgr", "8uc3": "bgr", "rgba8": "rgba", "bgra8": "bgra", "8uc4": "bgra"}
"""Encoding in lower case -> channels; the order of 8UC3 and 8UC4 is that of cv_bridge."""

_DEPTH_TYPES = {"16uc1": "uint16", "mono16": "uint16", "32fc1": "float32"}
"""Encoding in lower case -> type of a pixel: millimetres as integers, metres as floats (REP 118)."""

_FORMATS = ("PNG", "JPEG")
"""Formats of compressed images."""

_DEPTH_HEADER = struct.Struct("<iff")
"""Header of compressedDepth: format, and the two numbers of the quantization of inverse depth."""


def stamp_of(message: Any) -> int:
    """Return the time stamp of a message's header, nanoseconds; 0 if it was not set."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def stamp_name(stamp: int) -> str:
    """Return a time stamp in nanoseconds as text in seconds: the name of a recorded frame."""
    seconds, nanoseconds = divmod(abs(stamp), 10**9)
    return f"{'-' if stamp < 0 else ''}{seconds}.{nanoseconds:09d}"


def image_kind(message: Any) -> str:
    """Return "color" or "depth" for an image that `color_image` or `depth_image` can read, otherwise "other"."""
    if not hasattr(message, "format"):
        encoding = message.encoding.lower()
        return "color" if encoding in _COLOR_CHANNELS else "depth" if encoding in _DEPTH_TYPES else "other"
    encoding, _, transport = message.format.lower().partition(";")
    if "compresseddepth" in transport or encoding.strip() in _DEPTH_TYPES:
        return "depth"
    try:
        with Image.open(io.BytesIO(bytes(message.data)), formats=_FORMATS) as image:
            return "color" if image.mode in ("RGB", "RGBA") else "depth" if image.mode.startswith("I") else "other"
    except Exception:  # Decoders raise many kinds of exception on damaged images.
        return "other"


def camera_of(message: Any, color_topic: str) -> Intrinsics:
    """Return the intrinsics of the images of a topic from their CameraInfo.

    The matrix is P, without distortion, for rectified images (topics with `image_rect`), and otherwise K.

    Raises:
        InputError: as `Intrinsics.of`.
    """
    projection = np.asarray(getattr(message, "P", getattr(message, "p", ())), dtype=np.float64)
    if "image_rect" in color_topic and projection.size == 12 and projection[0] > 0:
        return Intrinsics.of_matrix(projection.reshape(3, 4)[:, :3], width=message.width, height=message.height)
    return Intrinsics.of(message)


def color_image(message: Any) -> NDArray[np.uint8]:
    """Return the colour image [H, W, 3] uint8 sRGB of an Image or a CompressedImage.

    Raises:
        InputError: the encoding is none of rgb8, bgr8, rgba8, bgra8, JPEG and PNG, or the data is damaged.
    """
    if hasattr(message, "format"):
        pixels = _decoded(bytes(message.data), message.format)
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
            raise InputError(f"color: a compressed image has the format {message.format!r}; expected 8-bit RGB")
        return np.ascontiguousarray(pixels[..., :3])
    channels = _COLOR_CHANNELS.get(message.encoding.lower())
    if channels is None:
        raise InputError(
            f"color: an image has the encoding {message.encoding!r}; expected rgb8, bgr8, rgba8, bgra8 or a compressed "
            "image"
        )
    pixels = _rows(message, "uint8", len(channels)).reshape(message.height, message.width, len(channels))
    return np.ascontiguousarray(pixels[..., [channels.index(color) for color in "rgb"]])


def depth_image(message: Any) -> NDArray[Any]:
    """Return the depth image [H, W] of an Image or a CompressedImage.

    Returns:
        uint16 in depth units (millimetres in ROS) or float32 in metres, as `RGBDFrame.depth`.

    Raises:
        InputError: the encoding is none of 16UC1, mono16, 32FC1 and PNG in `compressedDepth`, or the data is damaged.
    """
    if hasattr(message, "format"):
        return _compressed_depth(bytes(message.data), message.format)
    kind = _DEPTH_TYPES.get(message.encoding.lower())
    if kind is None:
        raise InputError(f"depth: an image has the encoding {message.encoding!r}; expected 16UC1, mono16 or 32FC1")
    return _rows(message, kind, 1)


def _rows(message: Any, kind: str, channels: int) -> NDArray[Any]:
    """Return the pixels [H, W * channels] of an Image, without the padding of its rows."""
    data, dtype = np.frombuffer(message.data, np.uint8), np.dtype(kind)
    height, step, used = int(message.height), int(message.step), int(message.width) * channels * dtype.itemsize
    if height * int(message.width) > MAX_IMAGE_PIXELS:
        raise InputError(f"an image has {message.width} x {height} pixels; expected at most {MAX_IMAGE_PIXELS}")
    if height * used == 0 or step < used or len(data) < height * step:
        raise InputError(
            f"an image has {len(data)} bytes in rows of {step}; expected {message.width} x {message.height} pixels of "
            f"{message.encoding}"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :used])
    return rows.view(dtype.newbyteorder(">" if message.is_bigendian else "<")).astype(dtype, copy=False)


def _decoded(content: bytes, described: str) -> NDArray[Any]:
    """Return the pixels of an untrusted PNG or JPEG."""
    with decoding(f"a compressed image ({described}) is damaged", "PNG or JPEG"):
        return decode_image(io.BytesIO(content), _FORMATS)[0]


def _compressed_depth(content: bytes, described: str) -> NDArray[Any]:
    encoding, _, transport = described.lower().partition(";")
    start = _DEPTH_HEADER.size if "compresseddepth" in transport else 0
    if start and ("rvl" in transport or len(content) < start):
        raise InputError(f"depth: a compressed image has the format {described!r}; expected compressedDepth png")
    pixels = _decoded(content[start:], described)
    if pixels.ndim != 2 or pixels.dtype == np.uint8 or not np.issubdtype(pixels.dtype, np.integer):
        raise InputError(f"depth: a compressed image has the format {described!r}; expected 16-bit PNG")
    depth = pixels.astype(np.uint16)
    if not start or encoding.strip() != "32fc1":
        return depth
    # compressed_depth_image_transport quantizes inverse depth: depth = scale / (value - offset).
    _, scale, offset = _DEPTH_HEADER.unpack_from(content)
    with np.errstate(all="ignore"):
        return np.where(depth > 0, scale / (depth - np.float32(offset)), 0).astype(np.float32)


def ros_time(stamp: int) -> dict[str, int]:
    """Return the fields of a builtin_interfaces/Time."""
    return {"sec": stamp // 10**9, "nanosec": stamp % 10**9}


def detection_array(detections: Sequence[Detection], *, stamp: int, frame_id: str) -> dict[str, Any]:
    """Return the fields of a vision_msgs/Detection2DArray (version 4, ROS 2), as nested mappings and lists.

    The name is `class_id`, empty for an unknown object, and the confidence is `score`. The position is the mean of the
    visible points; the rotation is the identity, since THOR2 does not estimate it. `id` is the number of the track,
    which is the same in all frames, or the label number if there are no tracks.

    Args:
        detections: detections in one frame.
        stamp: time of the colour image, nanoseconds.
        frame_id: coordinate frame of the colour camera.
    """
    header = {"stamp": ros_time(stamp), "frame_id": frame_id}
    return {"header": header, "detections": [{"header": header, **_detection_fields(one)} for one in detections]}


def _detection_fields(detection: Detection) -> dict[str, Any]:
    answer, box = detection.recognition, detection.box
    x, y, z = detection.position or (0.0, 0.0, 0.0)
    pose = {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    hypothesis = {"class_id": answer.name or "", "score": float(answer.confidence or 0.0)}
    middle = {"x": box.left + (box.width - 1) / 2, "y": box.top + (box.height - 1) / 2}
    number = getattr(answer, "track", answer.label)
    return {
        "results": [{"hypothesis": hypothesis, "pose": {"pose": pose, "covariance": [0.0] * 36}}],
        "bbox": {"center": {"position": middle, "theta": 0.0}, "size_x": float(box.width), "size_y": float(box.height)},
        "id": "" if number is None else str(number),
    }
