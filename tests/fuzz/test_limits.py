"""Readers that hang, crash or fill memory make a test fail, and the next reader is called."""

import os
import time
from typing import Any

import pytest


def test_a_hang_and_a_crash_are_failures(attempt: Any, reader_process: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(reader_process, "seconds", 0.1)
        for read in (lambda: time.sleep(1000), lambda: os._exit(3)):
            with pytest.raises(AssertionError, match="the reader crashed, or has not returned"):
                attempt(read)
    assert attempt(lambda: 3) == 3


def test_memory_is_bounded(attempt: Any, reader_process: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_process, "memory", 2**25)
    assert attempt(lambda: len(bytes(2**10))) == 2**10
    with pytest.raises(AssertionError, match="the reader takes"):
        attempt(lambda: len(b"x" * 2**26))


def test_refusals_have_one_line(attempt: Any) -> None:
    def refuse(message: str) -> None:
        raise OSError(message)

    assert attempt(lambda: refuse("depth.png: damaged")) is None
    for message in ("", "two\nlines", "x" * 20_000):
        with pytest.raises(AssertionError):
            attempt(lambda message=message: refuse(message))
    with pytest.raises(OSError, match="depth"):
        attempt(lambda: refuse("depth.png: damaged"), ())
