"""Errors as callers see them: a status and a JSON body that names the field."""

from typing import Any

from pydantic import BaseModel, Field

__all__ = ["Problem", "RequestError", "documented", "late"]

_REASONS = {
    400: "The body cannot be taken apart.",
    401: "The bearer token is missing or wrong.",
    408: "The body did not arrive in time.",
    413: "The body is too large.",
    415: "The body is of another type.",
    422: "A field is missing, damaged, too large or contradicts another.",
    429: "Too many requests wait already; come again after the seconds in Retry-After.",
    500: "A defect of this software.",
    503: "The service is starting or stopping.",
    504: "The answer was not ready in time.",
}


class Problem(BaseModel):
    """What is wrong with a request, or with the service."""

    field: str | None = Field(description="The part of the request that is at fault; null if it is none.")
    message: str = Field(description="One sentence.")


class RequestError(Exception):
    """Ends a request with `status` and a `Problem`. Its arguments are its fields, so that it can be pickled."""

    def __init__(self, status: int, field: str | None, message: str) -> None:
        super().__init__(status, field, message)
        self.status, self.field, self.message = status, field, message


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that can end with these statuses."""
    after = {"Retry-After": {"description": "Seconds.", "schema": {"type": "integer"}}}
    return {
        status: {"model": Problem, "description": _REASONS[status], **({"headers": after} if status == 429 else {})}
        for status in statuses
    }


def late() -> RequestError:
    """What ends a request past its deadline."""
    return RequestError(504, None, "The answer was not ready in time.")
