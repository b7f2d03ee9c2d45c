"""Failures that tests cause: interruptions, full disks, pickled programs."""

import contextlib
import errno
import resource
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest


class Pickled:
    """Ends the process that unpickles it, with an exception that readers do not catch."""

    def __reduce__(self) -> tuple[Any, ...]:
        return sys.exit, ("an object was unpickled",)


class Interrupted(BaseException):
    """Like KeyboardInterrupt, not an Exception."""


def interrupt_at(stage: str, step: int, call: Callable[..., object], *arguments: Any) -> None:
    """Call a training that shows its progress, and interrupt it at a step of a stage."""

    def progress(now: str, done: int, total: int, note: str) -> None:
        if (now, done) == (stage, step):
            raise Interrupted

    with pytest.raises(Interrupted):
        call(*arguments, progress=progress)


def full_disk(*_: Any, **__: Any) -> None:
    """Fail as a function that writes does on a full disk."""
    raise OSError(errno.ENOSPC, "No space left on device", "/tmp/secret")


@contextlib.contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Limit the size of the files that this process writes, in bytes: a larger one is an OSError."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
