"""Decoding of request bodies into frames and clouds.

Sizes are checked before anything is decompressed, and every error names the field.
"""

import io
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.image_files import ImageSizeError, decode_image, read_npy
from thor2_jax.frames.intrinsics import Intrinsics, parse_intrinsics
from thor2_jax.service.problem import RequestError, field_errors, parse_fields
from thor2_jax.service.schemas import CloudsBody
from thor2_jax.service.settings import MAX_BODY, MAX_CLOUD_COORDINATE, MAX_CLOUDS

__all__ = ["CloudArrays", "check_instances", "decode_frame", "decode_json_clouds", "decode_npz_clouds"]

MAX_UPLOAD_PIXELS = 1920 * 1080
"""Maximum number of pixels of an image."""

MAX_INSTANCES = 256
"""Maximum number of instances in a frame."""

MAX_INTRINSICS_BYTES = 4096
"""Maximum size of the intrinsics file."""

CloudArrays = list[tuple[NDArray[np.float32], NDArray[np.uint8]]]
"""Points [n, 3] in metres and sRGB colours [n, 3] of each cloud."""


def decode_frame(color: bytes, depth: bytes, intrinsics: bytes, labels: bytes | None = None) -> RGBDFrame:
    """Decode a frame from the contents of its files (formats of `frames.read_frame`; depth and labels only as PNG).

    Without `labels`, the frame has none.

    Raises:
        RequestError: 413 or 422, with the errors of all fields.
    """
    parsers: dict[str, Callable[[], Any]] = {
        "color": lambda: _decode_image("color", color, ("PNG", "JPEG"), ("RGB", "RGBA")),
        "depth": lambda: _decode_image("depth", depth, ("PNG",), ("I;16",)),
        "labels": lambda: (
            None if labels is None else _decode_image("labels", labels, ("PNG",), ("L", "P", "I;16", "I"))
        ),
        "intrinsics": lambda: _decode_intrinsics(intrinsics),
    }
    fields = parse_fields(parsers)
    with field_errors():
        frame = RGBDFrame(**fields | {"color": np.ascontiguousarray(fields["color"][..., :3])})
    if labels is not None:
        check_instances(frame)
    return frame


def check_instances(frame: RGBDFrame) -> None:
    """Raise RequestError (422) if the labels of a frame have more than `MAX_INSTANCES` instances."""
    with field_errors("labels"):
        count = len(frame.instances)
    if count > MAX_INSTANCES:
        raise RequestError(422, "labels", f"labels has {count} instances; expected at most {MAX_INSTANCES}.")


def _decode_intrinsics(content: bytes) -> Intrinsics:
    if len(content) > MAX_INTRINSICS_BYTES:
        message = f"intrinsics has {len(content)} bytes; expected at most {MAX_INTRINSICS_BYTES}."
        raise RequestError(413, "intrinsics", message)
    with field_errors("intrinsics"):
        return parse_intrinsics(content)


def _decode_image(field: str, content: bytes, formats: tuple[str, ...], modes: tuple[str, ...]) -> NDArray[Any]:
    try:
        pixels, mode = decode_image(io.BytesIO(content), formats, MAX_UPLOAD_PIXELS)
    except ImageSizeError as error:
        raise RequestError(413, field, f"{field} has {error}.") from None
    except Exception:  # Damaged files make the decoders raise many types of exception.
        raise RequestError(422, field, f"{field} is damaged, or not a {' or '.join(formats)} image.") from None
    if mode not in modes:
        expected = " or ".join(map(_mode_name, modes))
        raise RequestError(422, field, f"{field} is {_mode_name(mode)}; expected {expected}.")
    return pixels


def _mode_name(mode: str) -> str:
    depth, _, bits = mode.partition(";")
    names = {"1": "black and white", "L": "8-bit grey", "I": f"{bits or 32}-bit grey", "P": "indexed"}
    return names.get(depth, f"{bits or 8}-bit {depth}")


def decode_json_clouds(content: bytes) -> CloudArrays:
    """Decode clouds from JSON (`schemas.CloudsBody`). Raises RequestError (422)."""
    try:
        body = CloudsBody.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        field = ".".join(map(str, first["loc"]))[:200] or "body"
        raise RequestError(422, field, f"{field}: {first['msg'][:200]}.") from None
    clouds = []
    for k, cloud in enumerate(body.clouds):
        points, colors = np.array(cloud.points, np.float32), np.array(cloud.colors, np.uint8)
        if len(colors) != len(points):
            message = f"clouds.{k} has {len(points)} points and {len(colors)} colors."
            raise RequestError(422, f"clouds.{k}.colors", message)
        clouds.append((points.reshape(-1, 3), colors.reshape(-1, 3)))
    return clouds


def decode_npz_clouds(content: bytes) -> CloudArrays:
    """Decode clouds from an npz file: `points` [M, 3] float, `colors` [M, 3] uint8, `sizes` [B] points per cloud.

    Nothing is unpickled, and no array is allocated before its size is known.

    Raises:
        RequestError: 413 or 422.
    """
    arrays = _decode_npz(content)
    points, colors, sizes = arrays["points"], arrays["colors"], arrays["sizes"]
    for name, is_valid, expected in (
        ("points", points.dtype.kind == "f" and points.ndim == 2 and points.shape[1:] == (3,), "float [M, 3]"),
        ("colors", colors.dtype == np.uint8 and colors.shape == points.shape, "uint8 [M, 3], one row per point"),
        ("sizes", sizes.dtype.kind in "ui" and sizes.ndim == 1, "integer [B]"),
    ):
        if not is_valid:
            array = arrays[name]
            raise RequestError(422, name, f"{name} is {array.dtype} {list(array.shape)}; expected {expected}.")
    counts = sizes[: MAX_CLOUDS + 1].tolist()
    if not 1 <= len(counts) <= MAX_CLOUDS:
        raise RequestError(422, "sizes", f"sizes has {len(sizes)} entries; expected 1 to {MAX_CLOUDS}.")
    if min(counts) < 0 or max(counts) > POINT_BUCKETS[-1] or sum(counts) != len(points):
        message = f"sizes must lie between 0 and {POINT_BUCKETS[-1]} and sum to the {len(points)} points."
        raise RequestError(422, "sizes", message)
    if not (np.abs(points) <= MAX_CLOUD_COORDINATE).all():
        raise RequestError(422, "points", f"points has coordinates that are not within {MAX_CLOUD_COORDINATE} m.")
    starts = np.cumsum(counts)[:-1]
    return list(zip(np.split(points.astype(np.float32), starts), np.split(colors, starts), strict=True))


def _decode_npz(content: bytes) -> dict[str, NDArray[Any]]:
    names = ("points", "colors", "sizes")
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = {name: archive.getinfo(f"{name}.npy") for name in names if f"{name}.npy" in archive.namelist()}
    except Exception:  # Damaged archives raise many types of exception.
        raise RequestError(422, "body", "The body is not an npz file, or is damaged.") from None
    for name in names:
        if name not in entries:
            raise RequestError(422, name, f"{name} is missing from the npz file.")
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries.values()):
        raise RequestError(422, "body", "The npz file must be uncompressed or deflated.")
    total = sum(entry.file_size for entry in entries.values())
    if total > MAX_BODY:
        raise RequestError(413, "body", f"The arrays have {total} bytes; expected at most {MAX_BODY}.")
    arrays = {}
    for name, entry in entries.items():
        try:
            arrays[name] = read_npy(io.BytesIO(archive.read(entry)), entry.file_size)
        except Exception:  # As above.
            raise RequestError(422, name, f"{name} is not a numeric array, or is damaged.") from None
    return arrays
