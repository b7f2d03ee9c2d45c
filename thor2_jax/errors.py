"""Invalid input: the exception, a prefix for its message, arrays of any kind, damaged files, and missing packages."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["InputError", "as_array", "decoding", "needs_extra", "reason_of", "refusing_os_errors", "with_context"]

MAX_MESSAGE = 1000
"""Largest length of a message; a damaged file may contain a name or a number with millions of characters."""


class InputError(ValueError):
    """Invalid input from the user; its message names the argument or the file and the offending value, in one line.

    The command line prints it on standard error and exits with code 2. Every other exception is a defect of this
    software and keeps its traceback. Line breaks become spaces, and the middle of a message that would fill a screen is
    left out.
    """

    def __init__(self, message: str) -> None:
        message = " ".join(map(str.strip, message.splitlines()))
        if len(message) > MAX_MESSAGE:
            message = f"{message[: MAX_MESSAGE // 2]} ... {message[-MAX_MESSAGE // 2 :]}"
        super().__init__(message)


def as_array(values: ArrayLike, name: str, expected: str = "an array [n, 3]", dtype: Any = None) -> NDArray[Any]:
    """Return `values` as an array; rows of different lengths, and masked values, raise InputError."""
    if np.ma.is_masked(values):
        raise InputError(f"{name} is an array with masked values; expected {expected} without a mask; fill them")
    try:
        return np.asarray(values, dtype)
    except ValueError:
        raise InputError(f"{name} has rows of different lengths; expected {expected}") from None


def reason_of(error: BaseException) -> str:
    """Return why an exception was raised, in one line: its message, which may be from another package, or its type."""
    message = str(error)
    if isinstance(error, OSError) and error.strerror:
        message = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(InputError(message)) or type(error).__name__


@contextlib.contextmanager
def with_context(identifier: str) -> Iterator[None]:
    """Prefix the message of an InputError raised inside with `identifier`; a missing file becomes an InputError too.

    Raises:
        InputError: the original error, with the prefix.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{identifier}: {error.filename} is missing") from None
    except InputError as error:
        raise InputError(f"{identifier}: {error}") from None


@contextlib.contextmanager
def decoding(message: str, expected: str = "", *, advice: str = "") -> Iterator[None]:
    """Turn every exception of a decoder into an InputError, which says what is expected or gives advice."""
    try:
        yield
    except Exception as error:
        raise InputError(f"{message} ({reason_of(error)}); {advice or f'expected {expected}'}") from None


@contextlib.contextmanager
def refusing_os_errors(message: str, advice: str) -> Iterator[None]:
    """Turn an OSError into an InputError with the reason of the system between the message and the advice."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{message} ({error.strerror}); {advice}") from None


@contextlib.contextmanager
def needs_extra(subject: str, package: str, extra: str) -> Iterator[None]:
    """Turn a failed import into an InputError that names the package and the extra to install.

    Args:
        subject: beginning of the message, before the word "needs".
        package: name of the package.
        extra: extra of this distribution.

    Raises:
        InputError: the package is missing.
        ImportError: a module of this software is missing or has an error.
    """
    try:
        yield
    except ImportError as error:
        if (error.name or "").partition(".")[0] in ("thor2_jax", "training"):
            raise
        raise InputError(
            f"{subject} needs {package} ({error}); run pip install -c constraints.txt '.[{extra}]'"
        ) from None
