"""Bodies of requests, read into memory with a size limit and without temporary files, and the fields of forms."""

import re
from collections.abc import AsyncGenerator
from typing import Any

from fastapi import Request
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from thor2_jax.printable import check_name
from thor2_jax.service.problem import RequestError, field_errors, parse_fields
from thor2_jax.service.schemas import FORM
from thor2_jax.service.settings import MAX_BODY

__all__ = ["parse_enrolment", "parse_number", "read_body", "read_form"]


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
    """Return the whole body. Raises RequestError (413) if it is larger than `MAX_BODY`."""
    return b"".join([data async for data in _limited_stream(request)])


async def read_form(request: Request, form: dict[str, Any]) -> dict[str, bytes]:
    """Return the fields of a multipart form; those that `form`, an OpenAPI request body, does not have are ignored.

    Raises:
        RequestError: 413 if the body is larger than `MAX_BODY`, 415 for another content type or charset, 400 if the
            form cannot be parsed, 422 if a field is missing or repeated.
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
        fields = {}
        for name in schema["properties"]:
            values = received.getlist(name)
            if not values and name not in schema["required"]:
                continue
            if len(values) != 1:
                raise RequestError(422, name, f"{name} is {'given more than once' if values else 'missing'}.")
            fields[name] = await values[0].read() if isinstance(values[0], UploadFile) else values[0].encode()
        return fields
    finally:
        await received.close()


def parse_enrolment(fields: dict[str, bytes]) -> tuple[str, int, dict[str, bool]]:
    """Take the fields name, instance, extend and replace, of which the last two may be absent, out of a form.

    Returns:
        The name of the object, its number in the label image, and the flags extend and replace.

    Raises:
        RequestError: 422, with the errors of all fields.
    """
    values = parse_fields(
        {
            "name": lambda: _parse_name(fields.pop("name")),
            "instance": lambda: parse_number(fields, "instance"),
            "extend": lambda: _parse_flag(fields, "extend"),
            "replace": lambda: _parse_flag(fields, "replace"),
        }
    )
    name, instance = values.pop("name"), values.pop("instance")
    if all(values.values()):
        raise RequestError(422, "replace", "extend and replace are both true; choose one.")
    return name, instance, values


def _parse_name(content: bytes) -> str:
    with field_errors("name"):
        # A valid name has at most 4000 bytes; decoding and quoting all of a long one would take time.
        return check_name(content[:4004].decode(errors="surrogateescape"))


def _parse_flag(fields: dict[str, bytes], name: str) -> bool:
    value = fields.pop(name, b"false").lower()
    if value not in (b"true", b"1", b"false", b"0"):
        raise RequestError(422, name, f"{name} must be true or false.")
    return value in (b"true", b"1")


def parse_number(fields: dict[str, bytes], name: str) -> int:
    """Take the number in a field out of a form. Raises RequestError (422)."""
    content = fields.pop(name)
    if not re.fullmatch(rb"[0-9]{1,18}", content):
        raise RequestError(422, name, f"{name} is not a number; expected a whole number of at most 18 digits.")
    return int(content)
