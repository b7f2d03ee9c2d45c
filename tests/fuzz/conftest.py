"""Readers in a process of their own, where a hang and the memory they take are noticed."""

import contextlib
import multiprocessing
import re
import signal
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cloudpickle
import pytest
from processes import HANG, call_pickled

from thor2_jax.errors import InputError


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


class ReaderProcess:
    """Call functions in another process, which is replaced if one of them hangs.

    Attributes:
        seconds: after these a function hangs.
        memory: bytes that a reader may take beyond what the process holds.
    """

    seconds, memory = HANG, 2**30

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        # A forked process could deadlock on the locks of the threads of JAX.
        self.pool = multiprocessing.get_context("spawn").Pool(1, signal.signal, (signal.SIGINT, signal.SIG_IGN))

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return self.pool.apply_async(call_pickled, (cloudpickle.dumps((function, arguments)),)).get(self.seconds)
        except multiprocessing.TimeoutError:
            self.pool.terminate()
            self.start()
            raise AssertionError(f"the reader crashed, or has not returned after {self.seconds} s") from None


@pytest.fixture(scope="session")
def reader_process() -> Iterator[ReaderProcess]:
    process = ReaderProcess()
    yield process
    process.pool.close()  # The process ends by itself, which writes its coverage.
    process.pool.join()


@pytest.fixture
def attempt(reader_process: ReaderProcess, request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return a function that calls a reader and returns its result, or None if it raises one line."""
    cloudpickle.register_pickle_by_value(request.module)  # the process cannot import functions of test files

    def call(read: Callable[[], Any], refusals: Any = (InputError, OSError)) -> Any:
        result, message, memory = reader_process(measured, read, refusals)
        assert memory < reader_process.memory, f"the reader takes {memory} bytes"
        assert message is None or (message and "\n" not in message and len(message) < 20_000), message[:3000]
        return result

    return call
