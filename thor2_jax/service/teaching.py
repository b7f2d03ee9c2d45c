"""Requests that enroll and forget objects: their fields, and the errors of the gallery as error responses."""

import contextlib
import dataclasses
import logging
import re
from collections.abc import Iterator
from pathlib import Path

from fastapi import Request

from thor2_jax.errors import InputError
from thor2_jax.gallery.store import GalleryBusyError, GalleryError
from thor2_jax.printable import check_name
from thor2_jax.service.problem import RequestError

__all__ = ["Enrolment", "check_same_site", "gallery_errors", "generation_number", "instance_number", "parse_enrolment"]

log = logging.getLogger(__name__)

MAX_NAME_BYTES = 1000
"""Length in bytes up to which a name is checked, and named in an error."""


@dataclasses.dataclass(frozen=True)
class Enrolment:
    """The object that a request enrolls.

    Attributes:
        name: name of the object.
        instance: its number in the label image.
        extend: add the view to those of an object with this name.
        replace: discard the views of an object with this name.
    """

    name: str
    instance: int
    extend: bool
    replace: bool


def parse_enrolment(fields: dict[str, bytes]) -> Enrolment:
    """Return the enrolment of the form fields name, instance, extend and replace; the last two may be absent.

    Raises:
        RequestError: 422, with the errors of all fields.
    """
    errors: list[RequestError] = []

    def error(field: str, message: str) -> None:
        errors.append(RequestError(422, field, message))

    name = fields["name"]
    text = ""
    if len(name) > MAX_NAME_BYTES:
        error("name", f"name has {len(name)} bytes; expected a printable text of 1 to 200 characters.")
    else:
        try:
            text = check_name(name.decode())
        except UnicodeDecodeError:
            error("name", "name is not valid UTF-8; expected a printable text of 1 to 200 characters.")
        except InputError as problem:
            error("name", f"{problem}.")
    instance = 0
    try:
        instance = instance_number(fields["instance"])
    except RequestError as problem:
        errors.append(problem)
    flags = {}
    for field in ("extend", "replace"):
        value = fields.get(field, b"false").lower()
        if value not in (b"true", b"1", b"false", b"0"):
            error(field, f"{field} must be true or false.")
        flags[field] = value in (b"true", b"1")
    if all(flags.values()):
        error("replace", "extend and replace are both true; choose one.")
    if errors:
        raise RequestError.merge(errors)
    return Enrolment(text, instance, flags["extend"], flags["replace"])


def instance_number(field: bytes) -> int:
    """Return the form field instance. Raises RequestError (422)."""
    if not re.fullmatch(rb"[0-9]{1,10}", field):
        message = "instance is not a number; expected the object's number in the label image."
        raise RequestError(422, "instance", message)
    return int(field)


def generation_number(fields: dict[str, bytes]) -> int:
    """Return the form field generation. Raises RequestError (422)."""
    if not re.fullmatch(rb"[0-9]{1,18}", fields["generation"]):
        raise RequestError(422, "generation", "generation is not a number; expected that of the change's answer.")
    return int(fields["generation"])


async def check_same_site(request: Request) -> None:
    """Raise RequestError (403) if a web page of another site sends the request, as browsers let any page do."""
    site, origin = request.headers.get("sec-fetch-site"), request.headers.get("origin")
    if site is not None:  # Browsers send it to https and to localhost.
        is_foreign = site not in ("same-origin", "none")
    else:
        is_foreign = origin is not None and origin.partition("://")[2] != request.headers.get("host")
    if is_foreign:
        raise RequestError(403, "Origin", "The request comes from a web page of another site.")


@contextlib.contextmanager
def gallery_errors(directory: Path | None, refused: int, field: str) -> Iterator[None]:
    """Turn the errors of a gallery into error responses; they do not say where it lies.

    Args:
        directory: directory of the gallery.
        refused: status for a change that the gallery refuses.
        field: field of the request that is then concerned.

    Raises:
        RequestError: 500 for a gallery that cannot be read, 503 while another process writes to it, 507 if it cannot be
            written, `refused` for other errors. The gallery is as before.
    """
    try:
        yield
    except (GalleryError, OSError) as error:
        log.error("%s", error)
        if isinstance(error, OSError):
            message = f"The gallery cannot be read or written ({error.strerror}); it is as before."
            raise RequestError(507, None, message) from None
        message = str(error).replace(f"{directory}/", "").replace(str(directory), "the directory")
        raise RequestError(503 if isinstance(error, GalleryBusyError) else 500, None, f"{message}.") from None
    except InputError as error:
        raise RequestError(refused, field, f"{error}.") from None
