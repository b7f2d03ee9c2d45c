"""Readers in a process of their own, where a hang and the memory they take are noticed."""

import contextlib
import multiprocessing
import re
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import pytest
from processes import HANG, call_pickled

from thor2_jax.errors import InputError
from thor2_jax.processes import Processes


@contextlib.contextmanager
def other_content(path: Path, content: bytes) -> Iterator[None]:
    """Let a file have another content for a while."""
    whole = path.read_bytes()
    path.write_bytes(content)
    try:
        yield
    finally:
        path.write_bytes(whole)


def measured(read: Callable[[], Any], refusals: Any) -> tuple[Any, str | None, int]:
    """Return the result of a reader, or None and the message of its refusal, and the bytes that it took at most."""

    def memory(kind: str) -> int:
        return 1024 * int(re.findall(rf"{kind}:\s*(\d+) kB", Path("/proc/self/status").read_text())[0])

    Path("/proc/self/clear_refs").write_text("5")  # The peak is counted from here.
    before, result, message = memory("VmRSS"), None, None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # decoders warn about damaged files
        try:
            result = read()
        except refusals as error:
            message = str(error)
    return result, message, memory("VmHWM") - before


@pytest.fixture(scope="session")
def reader_process() -> Iterator[Processes]:
    """A process that is replaced if a function hangs or ends it; a forked one could deadlock on the locks of JAX."""
    process = Processes(1, multiprocessing.get_context("spawn"), int, signal.SIGINT)
    yield process
    with contextlib.suppress(ChildProcessError):
        process.submit(sys.exit).result()  # The process ends by itself, which writes its coverage.
    process.close()


@pytest.fixture
def attempt(reader_process: Processes, request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return a function that calls a reader and returns its result, or None if it raises one line.

    The reader may take `seconds`, and `most` bytes beyond what its process holds.
    """
    cloudpickle.register_pickle_by_value(request.module)  # the process cannot import functions of test files

    def call(
        read: Callable[[], Any], refusals: Any = (InputError, OSError), seconds: float = HANG, most: float = 2**30
    ) -> Any:
        content, deadline = cloudpickle.dumps((measured, (read, refusals))), time.monotonic() + seconds
        result, message, memory = reader_process.submit(call_pickled, content, deadline=deadline).result()
        assert memory < most, f"the reader takes {memory} bytes"
        assert message is None or (message and "\n" not in message and len(message) < 20_000), message[:3000]
        return result

    return call
