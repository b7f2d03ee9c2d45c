"""Errors of the API: an HTTP status and a JSON body that names the field concerned."""

from typing import Any

from pydantic import BaseModel, Field

__all__ = ["Problem", "RequestError", "deadline_exceeded", "error_responses"]

_DESCRIPTIONS = {
    400: "The body cannot be parsed.",
    401: "The bearer token is missing or invalid.",
    408: "The body did not arrive before the deadline.",
    413: "The body is too large.",
    415: "The content type of the body is not supported.",
    422: "A field is missing, damaged, too large, or inconsistent with another field.",
    429: "The queue is full; repeat the request after the number of seconds in Retry-After.",
    500: "Internal error of the service.",
    503: "The service is starting or stopping.",
    504: "The deadline of the request was exceeded.",
}


class Problem(BaseModel):
    """The body of an error response."""

    field: str | None = Field(description="Field of the request that caused the error; null if there is none.")
    message: str = Field(description="Description of the error in one sentence.")


class RequestError(Exception):
    """Error response of a request: a status and the fields of `Problem`. It can be pickled."""

    def __init__(self, status: int, field: str | None, message: str) -> None:
        super().__init__(status, field, message)
        self.status, self.field, self.message = status, field, message


def error_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI `responses` of a route for these error statuses."""
    retry_after = {"Retry-After": {"description": "Seconds.", "schema": {"type": "integer"}}}
    return {
        status: {
            "model": Problem,
            "description": _DESCRIPTIONS[status],
            **({"headers": retry_after} if status == 429 else {}),
        }
        for status in statuses
    }


def deadline_exceeded() -> RequestError:
    """Return the error of a request whose deadline has passed."""
    return RequestError(504, None, "The deadline of the request was exceeded.")
