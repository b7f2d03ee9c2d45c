"""Readers under limits of time and memory."""

import contextlib
import resource
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from thor2_jax.errors import InputError

SECONDS = 5
"""CPU time that a reader may take; elapsed time would depend on other processes."""

MEMORY = 2**30
"""Bytes that a reader may allocate beyond what the process holds."""


class TimeLimitExceeded(BaseException):
    """Not an `Exception`, so that no handler of the reader catches it."""


@contextlib.contextmanager
def limits() -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TimeLimitExceeded

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, handler)


@pytest.fixture(scope="session")
def attempt() -> Callable[..., Any]:
    """Return a function that calls a reader under the limits and returns its result, or None if it raises one line."""

    def call(read: Callable[[], Any], refusals: Any = (InputError, OSError)) -> Any:
        with warnings.catch_warnings(), limits():
            warnings.simplefilter("ignore")  # decoders warn about damaged files
            try:
                return read()
            except refusals as error:
                message = str(error)
        assert message and "\n" not in message and len(message) < 20_000, message[:3000]
        return None

    return call
