"""Errors of the API: an HTTP status and a JSON body that names the field."""

import contextlib
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, Field

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters

__all__ = ["FieldError", "Problem", "RequestError", "error_responses", "field_errors"]

_DESCRIPTIONS = {
    400: "The body cannot be parsed.",
    401: "The bearer token is missing or invalid.",
    403: "The request comes from a web page of another site, or its header Host names another server.",
    404: "No object has this name.",
    408: "The body did not arrive before the deadline.",
    409: "The change conflicts with the gallery: the name exists, or another change was made since.",
    413: "The body is too large.",
    415: "The content type of the body is not supported.",
    422: "A field is missing, damaged, too large, or inconsistent with another field.",
    429: "The queue is full; repeat the request after the number of seconds in Retry-After.",
    500: "Internal error of the service, or a damaged gallery.",
    503: "The service is starting or stopping, explanations are being compiled, or another process is writing to the "
    "gallery.",
    504: "The deadline of the request was exceeded (--deadline of thor2 serve); many objects need more time.",
    507: "The gallery cannot be written, for example on a full disk; it is as before.",
}


class FieldError(BaseModel):
    """Error of one field of a request."""

    field: str | None = Field(description="Field of the request that caused the error; null if there is none.")
    message: str = Field(description="Description of the error in one sentence.")


class Problem(FieldError):
    """The body of an error response."""

    further: list[FieldError] = Field(default=[], description="Errors of further fields; absent if there are none.")


class RequestError(Exception):
    """Error response of a request: a status and the fields of `Problem`; it can be pickled.

    The message is by default the description of the status.

    Attributes:
        retry_after: seconds after which a request with status 429 or 503 may be repeated.
    """

    def __init__(self, status: int, field: str | None = None, message: str | None = None, retry_after: int = 1) -> None:
        super().__init__(status, field, message)
        self.status, self.field, self.retry_after = status, field, retry_after
        text = _DESCRIPTIONS[status] if message is None else escape_characters(message)
        self.message = text[:-1] if text.endswith("....") else text  # the list of a message may end in three dots
        self.further: list[RequestError] = []


@contextlib.contextmanager
def field_errors(field: str | None = None) -> Iterator[None]:
    """Turn an InputError into a RequestError (422) about a field, by default the first word of the message."""
    try:
        yield
    except InputError as error:
        raise RequestError(422, field or str(error).split(maxsplit=1)[0], f"{error}.") from None


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI `responses` of a route for these error statuses."""
    retry = {"headers": {"Retry-After": {"description": "Seconds.", "schema": {"type": "integer"}}}}
    return {
        status: {"model": Problem, "description": _DESCRIPTIONS[status], **(retry if status in (429, 503) else {})}
        for status in statuses
    }
