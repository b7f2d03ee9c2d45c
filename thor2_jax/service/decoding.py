"""Reading of request bodies into memory, with a size limit, and decoding of forms, frames and clouds.

Sizes are checked before anything is decompressed, nothing is written to temporary files, and every error names the
field.
"""

import io
import re
import zipfile
from collections.abc import AsyncGenerator, Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from thor2_jax.files import read_npy
from thor2_jax.frames.frames import ImageSizeError, RGBDFrame, decode_image
from thor2_jax.frames.intrinsics import Intrinsics, parse_intrinsics
from thor2_jax.printable import check_name
from thor2_jax.service.problem import RequestError, field_errors
from thor2_jax.service.schemas import FORM, MAX_CLOUD_COORDINATE, MAX_CLOUDS, MAX_POINTS, CloudsBody

__all__ = ["decode_frame", "decode_json_clouds", "decode_npz_clouds", "read_body", "read_form"]

MAX_BODY = 16 * 2**20
"""Largest size of a request body, and of the arrays it decompresses to, in bytes."""

MAX_UPLOAD_PIXELS = 1920 * 1080
"""Largest number of pixels of an image."""

MAX_INTRINSICS_BYTES = 4096
"""Largest size of the intrinsics file."""

CloudArrays = list[tuple[NDArray[np.float32], NDArray[np.uint8]]]
"""Points [n, 3] in metres and sRGB colours [n, 3] of each cloud."""


async def _limited_stream(request: Request) -> AsyncGenerator[bytes, None]:
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and (len(declared) >= 20 or int(declared) > MAX_BODY):
        raise RequestError(413, "body", f"The body has {declared[:20]} bytes; expected at most {MAX_BODY}.")
    received = 0
    async for data in request.stream():
        received += len(data)
        if received > MAX_BODY:
            raise RequestError(413, "body", f"The body has more than {MAX_BODY} bytes.")
        yield data


async def read_body(request: Request) -> bytes:
    """Return the whole body; raise RequestError (413) if it is larger than `MAX_BODY`."""
    return b"".join([data async for data in _limited_stream(request)])


async def read_form(request: Request, form: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a multipart form, which must be those of `form`, an OpenAPI request body.

    Files are returned as bytes; names, numbers and flags are parsed.

    Raises:
        RequestError: 413 if the body is larger than `MAX_BODY`, 415 for another content type or charset, 400 if the
            form cannot be parsed, 422 if a field is missing, repeated, unknown or invalid.
    """
    schema = form["content"][FORM]["schema"]
    content_type, options = parse_options_header(request.headers.get("content-type"))
    if content_type != FORM.encode():
        raise RequestError(415, "body", f"The body must be {FORM}.")
    # Some Python codecs raise on undecodable input, and some take quadratic time.
    if options.get(b"charset", b"utf-8").lower() not in (b"utf-8", b"iso-8859-1", b"us-ascii"):
        raise RequestError(415, "body", "The charset must be utf-8, iso-8859-1 or us-ascii.")
    parser = MultiPartParser(
        request.headers, _limited_stream(request), max_files=8, max_fields=8, max_part_size=MAX_BODY
    )
    parser.spool_max_size = MAX_BODY + 1  # Larger files would be written to a temporary file.
    try:
        received = await parser.parse()
    except MultiPartException as error:
        raise RequestError(400, "body", error.message) from None
    try:
        if unknown := received.keys() - schema["properties"].keys():
            message = f"The form has the field {min(unknown)[:40]!r}; expected {', '.join(schema['properties'])}."
            raise RequestError(422, "body", message)
        parsers: dict[str, Callable[[], Any]] = {}
        for name in schema["properties"]:
            given = received.getlist(name)
            values = [await value.read() if isinstance(value, UploadFile) else value.encode() for value in given]
            if values or name in schema["required"]:
                parsers[name] = partial(_parse_field, name, values)
    finally:
        await received.close()
    return _parse_fields(parsers)


def _parse_field(name: str, values: list[bytes]) -> Any:
    if len(values) != 1:
        raise RequestError(422, name, f"{name} is {'given more than once' if values else 'missing'}.")
    # A valid name has at most 4000 bytes; decoding and quoting a long one completely would take time.
    with field_errors(name):
        return (
            _PARSERS[name](name, values[0][:4004].decode(errors="surrogateescape")) if name in _PARSERS else values[0]
        )


def _parse_flag(field: str, text: str) -> bool:
    if text.lower() not in ("true", "1", "false", "0"):
        raise RequestError(422, field, f"{field} is {text[:40]!r}; expected true or false.")
    return text.lower() in ("true", "1")


def _parse_number(field: str, text: str) -> int:
    if not re.fullmatch("[0-9]{1,18}", text):
        raise RequestError(422, field, f"{field} is {text[:40]!r}; expected a whole number of at most 18 digits.")
    return int(text)


_PARSERS: dict[str, Callable[[str, str], Any]] = {
    "name": lambda _, text: check_name(text),
    "instance": _parse_number,
    "extend": _parse_flag,
    "replace": _parse_flag,
    "generation": _parse_number,
}
"""Parsers of the fields of forms that are not files."""


def _parse_fields(parsers: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
    """Call the parser of each field of a request and return their results.

    Raises:
        RequestError: with the errors of all fields; the first one determines the status.
    """
    values, errors = {}, []
    for name, parse in parsers.items():
        try:
            values[name] = parse()
        except RequestError as error:
            errors.append(error)
    if errors:
        errors[0].further = errors[1:]
        raise errors[0]
    return values


def decode_frame(color: bytes, depth: bytes, intrinsics: bytes, labels: bytes | None = None) -> RGBDFrame:
    """Decode a frame from the contents of its files (formats of `frames.read_frame`; depth and labels only as PNG).

    Without `labels`, the frame has no labels.

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
    fields = _parse_fields(parsers)
    with field_errors():
        return RGBDFrame(**fields | {"color": np.ascontiguousarray(fields["color"][..., :3])})


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
    """Decode clouds from JSON (`schemas.CloudsBody`); raise RequestError (422) if they are invalid."""
    try:
        body = CloudsBody.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        field = ".".join(map(str, first["loc"]))[:200] or "body"
        raise RequestError(422, field, f"{field}: {first['msg'][:200]}.") from None
    clouds = []
    for k, cloud in enumerate(body.clouds):
        points, colors = np.array(cloud.points, np.float32), np.rint(cloud.colors).astype(np.uint8)
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
        raise RequestError(422, "sizes", f"sizes describes {len(sizes)} clouds; expected 1 to {MAX_CLOUDS}.")
    if min(counts) < 0 or max(counts) > MAX_POINTS or sum(counts) != len(points):
        message = f"sizes must lie between 0 and {MAX_POINTS} and sum to the {len(points)} points."
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
    if missing := [name for name in names if name not in entries]:
        raise RequestError(422, missing[0], f"{missing[0]} is missing from the npz file.")
    if any(entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for entry in entries.values()):
        raise RequestError(422, "body", "The npz file must be uncompressed or deflated.")
    total = sum(entry.file_size for entry in entries.values())
    if total > MAX_BODY:
        raise RequestError(413, "body", f"The arrays have {total} bytes; expected at most {MAX_BODY}.")
    arrays = {}
    for name, entry in entries.items():
        try:
            arrays[name] = read_npy(io.BytesIO(archive.read(entry)), entry.file_size)
        except Exception:  # Damaged arrays do so, too.
            raise RequestError(422, name, f"{name} is not a numeric array, or is damaged.") from None
    return arrays
