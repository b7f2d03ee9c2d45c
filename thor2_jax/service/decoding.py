"""Bytes of a request to a frame or to clouds.

Sizes are checked before anything is unpacked, and every error names the field.
"""

import io
import json
import math
import zipfile
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import ValidationError

from thor2_jax.capacity import POINT_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.recognition.frames import Intrinsics, RGBDFrame
from thor2_jax.service.problem import RequestError
from thor2_jax.service.schemas import Clouds
from thor2_jax.service.settings import FARTHEST, MAX_BODY, MAX_CLOUDS, MAX_INSTANCES, MAX_PIXELS, MAX_TEXT

__all__ = ["CloudArrays", "clouds_of_json", "clouds_of_npz", "frame_of"]

CloudArrays = list[tuple[NDArray[np.float32], NDArray[np.uint8]]]
"""Points [n, 3] in metres and colours [n, 3] of each cloud."""


def frame_of(color: bytes, depth: bytes, labels: bytes, intrinsics: bytes) -> RGBDFrame:
    """A frame of the files' contents (formats as in `frames.read_frame`, depth and labels PNG only).

    Raises:
        RequestError: 413 or 422.
    """
    camera = _intrinsics(intrinsics)
    images = {
        "color": _image("color", color, ("PNG", "JPEG"), ("RGB", "RGBA")),
        "depth": _image("depth", depth, ("PNG",), ("I;16",)),
        "labels": _image("labels", labels, ("PNG",), ("L", "P", "I;16", "I")),
    }
    try:
        frame = RGBDFrame(np.ascontiguousarray(images["color"][..., :3]), images["depth"], images["labels"], camera)
    except InputError as error:
        raise RequestError(422, str(error).split(maxsplit=1)[0], f"{error}.") from None
    if len(frame.instances) > MAX_INSTANCES:
        raise RequestError(422, "labels", f"labels has {len(frame.instances)} instances; at most {MAX_INSTANCES}.")
    return frame


def _intrinsics(content: bytes) -> Intrinsics:
    if len(content) > MAX_TEXT:
        raise RequestError(413, "intrinsics", f"intrinsics has {len(content)} bytes; at most {MAX_TEXT} are taken.")
    try:
        return Intrinsics.of(json.loads(content))
    except InputError as error:
        raise RequestError(422, "intrinsics", f"{error}.") from None
    except (ValueError, RecursionError):
        raise RequestError(422, "intrinsics", "intrinsics is no JSON, or nested too deeply.") from None


def _image(field: str, content: bytes, formats: tuple[str, ...], modes: tuple[str, ...]) -> NDArray[Any]:
    def bad(status: int, what: str) -> RequestError:
        return RequestError(status, field, f"{field} {what}.")

    try:
        image = Image.open(io.BytesIO(content), formats=formats)
    except Exception:  # damaged files make the decoders raise anything; only bytes are at work here
        raise bad(422, f"is no {' or '.join(formats)}, or its header is damaged") from None
    width, height = image.size
    if width * height > MAX_PIXELS:
        raise bad(413, f"has {width} x {height} pixels; at most {MAX_PIXELS} are taken")
    if image.mode not in modes:
        raise bad(422, f"is {_kind(image.mode)}; expected {' or '.join(map(_kind, modes))}")
    try:
        image.verify()  # decoding passes over the checksums of a PNG's pixels
        return np.asarray(Image.open(io.BytesIO(content), formats=formats))
    except Exception:  # as above
        raise bad(422, "is damaged or cut short") from None


def _kind(mode: str) -> str:
    kinds = {"1": "black and white", "L": "8-bit grey", "I;16": "16-bit grey", "I": "32-bit grey", "P": "indexed"}
    return kinds.get(mode, mode)


def clouds_of_json(content: bytes) -> CloudArrays:
    """Clouds of the JSON form, `schemas.Clouds`. Raises RequestError (422)."""
    try:
        found = Clouds.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "body"
        raise RequestError(422, where[:200], f"{where[:200]}: {first['msg'][:200]}.") from None
    clouds = []
    for k, cloud in enumerate(found.clouds):
        points, colors = (np.array(rows).reshape(-1, 3) for rows in (cloud.points, cloud.colors))
        clouds.append(_cloud(f"clouds.{k}", points, colors.astype(np.uint8)))
    return clouds


def clouds_of_npz(content: bytes) -> CloudArrays:
    """Clouds of the npz form: `points` [M, 3] floats, `colors` [M, 3] uint8, `sizes` [B] points of each cloud.

    Nothing is unpickled, and no array is made before its size is known.

    Raises:
        RequestError: 413 or 422.
    """
    arrays = _unpacked(content)
    points, colors, sizes = arrays["points"], arrays["colors"], arrays["sizes"]
    for name, ok, expected in (
        ("points", points.dtype.kind == "f" and points.ndim == 2 and points.shape[1:] == (3,), "floats [M, 3]"),
        ("colors", colors.dtype == np.uint8 and colors.shape == points.shape, "uint8 [M, 3], as many as points"),
        ("sizes", sizes.dtype.kind in "ui" and sizes.ndim == 1, "integers [B]"),
    ):
        if not ok:
            found = arrays[name]
            raise RequestError(422, name, f"{name} is {found.dtype} {list(found.shape)}; expected {expected}.")
    counts = [int(n) for n in sizes[: MAX_CLOUDS + 1]]
    if not 1 <= len(counts) <= MAX_CLOUDS:
        raise RequestError(422, "sizes", f"sizes has {len(sizes)} entries; expected 1 to {MAX_CLOUDS}.")
    if min(counts) < 0 or max(counts) > POINT_BUCKETS[-1] or sum(counts) != len(points):
        raise RequestError(
            422, "sizes", f"sizes must lie between 0 and {POINT_BUCKETS[-1]} and add up to the {len(points)} points."
        )
    ends = np.cumsum(counts)
    return [_cloud("points", points[end - n : end], colors[end - n : end]) for n, end in zip(counts, ends, strict=True)]


def _unpacked(content: bytes) -> dict[str, NDArray[Any]]:
    names = ("points", "colors", "sizes")
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
        entries = {name: archive.getinfo(f"{name}.npy") for name in names if f"{name}.npy" in archive.namelist()}
    except Exception:  # damaged archives raise anything; only bytes are at work here
        raise RequestError(422, "body", "The body is no npz file, or is damaged.") from None
    for name in names:
        if name not in entries:
            raise RequestError(422, name, f"{name} is missing.")
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries.values()):
        raise RequestError(422, "body", "The npz file must be stored or deflated.")
    total = sum(entry.file_size for entry in entries.values())
    if total > MAX_BODY:
        raise RequestError(413, "body", f"The arrays have {total} bytes; at most {MAX_BODY} are taken.")
    return {name: _npy(name, archive, entry) for name, entry in entries.items()}


def _npy(name: str, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    try:
        stream = io.BytesIO(archive.read(entry))  # never more than entry.file_size
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, by_columns, dtype = read_header[version](stream)
        data = stream.read()
        if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data):
            raise ValueError
        return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")
    except Exception:  # as above
        raise RequestError(422, name, f"{name} is no array of numbers, or is damaged.") from None


def _cloud(field: str, points: NDArray[Any], colors: NDArray[np.uint8]) -> tuple[Any, NDArray[np.uint8]]:
    if colors.shape != points.shape:
        raise RequestError(422, f"{field}.colors", f"{field} has {len(points)} points and {len(colors)} colors.")
    if not (np.abs(points) <= FARTHEST).all():
        raise RequestError(422, field, f"{field} has coordinates that are not within {FARTHEST} m.")
    return points.astype(np.float32), colors
