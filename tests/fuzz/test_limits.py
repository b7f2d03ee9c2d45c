"""Readers that hang, crash, fill memory or raise long messages make a test fail, and the next reader is called."""

import os
import time
from typing import Any

import pytest


def test_bad_readers_are_failures(attempt: Any, reader_process: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(message: str) -> None:
        raise OSError(message)

    with monkeypatch.context() as patch:
        patch.setattr(reader_process, "seconds", 0.1)
        for read in (lambda: time.sleep(1000), lambda: os._exit(3)):
            with pytest.raises(AssertionError, match="the reader crashed, or has not returned"):
                attempt(read)
    for message in ("", "two\nlines", "x" * 20_000):
        with pytest.raises(AssertionError):
            attempt(lambda message=message: refuse(message))
    with pytest.raises(OSError, match="depth"):
        attempt(lambda: refuse("depth.png: damaged"), ())
    monkeypatch.setattr(reader_process, "memory", 2**25)
    with pytest.raises(AssertionError, match="the reader takes"):
        attempt(lambda: len(b"x" * 2**26))
    assert attempt(lambda: refuse("depth.png: damaged")) is None
    assert attempt(lambda: len(bytes(2**10))) == 2**10
