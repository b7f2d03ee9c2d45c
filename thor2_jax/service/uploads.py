"""Bodies of requests in memory: never more than the limit, never on the disk."""

from collections.abc import AsyncGenerator

from fastapi import Request
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from thor2_jax.service.problem import RequestError
from thor2_jax.service.settings import MAX_BODY

__all__ = ["read_body", "read_form"]


async def _chunks(request: Request) -> AsyncGenerator[bytes, None]:
    declared = request.headers.get("content-length", "")
    left = MAX_BODY - (int(declared) if declared.isdecimal() and len(declared) < 20 else 0)
    if left < 0:
        raise RequestError(413, "body", f"The body has {declared} bytes; at most {MAX_BODY} are taken.")
    left = MAX_BODY
    async for chunk in request.stream():
        left -= len(chunk)
        if left < 0:
            raise RequestError(413, "body", f"The body has more than {MAX_BODY} bytes.")
        yield chunk


async def read_body(request: Request) -> bytes:
    """The whole body. Raises RequestError (413) past `MAX_BODY` bytes."""
    return b"".join([chunk async for chunk in _chunks(request)])


async def read_form(request: Request, names: tuple[str, ...]) -> dict[str, bytes]:
    """The parts of these names of a multipart form; others are passed over.

    Raises:
        RequestError: 413 past `MAX_BODY` bytes, 415 for another type of body or charset, 400 for one that
            cannot be taken apart, 422 for a part that is missing or given twice.
    """
    kind, options = parse_options_header(request.headers.get("content-type"))
    if kind != b"multipart/form-data":
        raise RequestError(415, "body", "The body must be multipart/form-data.")
    # Some of Python's charsets fail on what they cannot decode, and some take time as the square of its length.
    if options.get(b"charset", b"utf-8").lower() not in (b"utf-8", b"iso-8859-1", b"us-ascii"):
        raise RequestError(415, "body", "The charset must be utf-8, iso-8859-1 or us-ascii.")
    parser = MultiPartParser(request.headers, _chunks(request), max_files=8, max_fields=8, max_part_size=MAX_BODY)
    parser.spool_max_size = MAX_BODY + 1  # what is larger would go to a temporary file
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise RequestError(400, "body", error.message) from None
    try:
        found = {}
        for name in names:
            parts = form.getlist(name)
            if len(parts) != 1:
                raise RequestError(422, name, f"{name} is {'given more than once' if parts else 'missing'}.")
            found[name] = await parts[0].read() if isinstance(parts[0], UploadFile) else parts[0].encode()
        return found
    finally:
        await form.close()
