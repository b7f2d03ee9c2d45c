"""Reading of request bodies into memory, with a size limit and without temporary files."""

from collections.abc import AsyncGenerator

from fastapi import Request
from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from thor2_jax.service.problem import RequestError
from thor2_jax.service.settings import MAX_BODY

__all__ = ["read_body", "read_form"]


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


async def read_form(request: Request, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, bytes]:
    """Return the fields `names` of a multipart form, and those of `optional` that it has; other fields are ignored.

    Raises:
        RequestError: 413 if the body is larger than `MAX_BODY`, 415 for another content type or charset, 400 if the
            form cannot be parsed, 422 if a field is missing or repeated.
    """
    content_type, options = parse_options_header(request.headers.get("content-type"))
    if content_type != b"multipart/form-data":
        raise RequestError(415, "body", "The body must be multipart/form-data.")
    # Some Python codecs raise on undecodable input, and some take quadratic time.
    if options.get(b"charset", b"utf-8").lower() not in (b"utf-8", b"iso-8859-1", b"us-ascii"):
        raise RequestError(415, "body", "The charset must be utf-8, iso-8859-1 or us-ascii.")
    parser = MultiPartParser(
        request.headers, _limited_stream(request), max_files=8, max_fields=8, max_part_size=MAX_BODY
    )
    parser.spool_max_size = MAX_BODY + 1  # Larger files would be written to a temporary file.
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise RequestError(400, "body", error.message) from None
    try:
        fields = {}
        for name in (*names, *optional):
            values = form.getlist(name)
            if not values and name in optional:
                continue
            if len(values) != 1:
                raise RequestError(422, name, f"{name} is {'given more than once' if values else 'missing'}.")
            fields[name] = await values[0].read() if isinstance(values[0], UploadFile) else values[0].encode()
        return fields
    finally:
        await form.close()
