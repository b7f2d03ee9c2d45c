"""A simulated disk that fails at a chosen step."""

import builtins
import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


class Disk:
    """Count the write operations under a directory, and fail from the n-th on, like a full or read-only disk.

    Opening for writing, writing, creating a directory and renaming each count once. Removing never fails.
    """

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.count, self.fail_at, self.number = str(folder), 0, 0, errno.ENOSPC
        for module, name in ((builtins, "open"), (io, "open")):
            patch.setattr(module, name, self._opening(getattr(module, name)))
        for name in ("mkdir", "rename", "replace"):
            patch.setattr(os, name, self._failing(getattr(os, name)))
        low = os.open
        patch.setattr(
            os,
            "open",
            lambda path, flags, *a, **k: (flags & os.O_CREAT and self.step(path), low(path, flags, *a, **k))[1],
        )

    def step(self, path: Any) -> None:
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(self.folder):
            self.count += 1
            if self.fail_at and self.count >= self.fail_at:
                raise OSError(self.number, os.strerror(self.number), os.fspath(path))

    def _failing(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(path: Any, *rest: Any, **more: Any) -> Any:
            self.step(path)
            return function(path, *rest, **more)

        return wrapper

    def _opening(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(path: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
            if set(mode) & set("wxa+"):
                self.step(path)
            stream = function(path, mode, *rest, **more)
            if set(mode) & set("wxa+") and isinstance(path, (str, os.PathLike)):
                self._failing_writes(stream, path)
            return stream

        return wrapper

    def _failing_writes(self, stream: Any, path: Any) -> None:
        write = stream.write

        def failing_write(content: Any) -> Any:
            try:
                self.step(path)
            except OSError:
                write(content[: len(content) // 2])  # the part that still fits
                raise
            return write(content)

        stream.write = failing_write

    def reset(self, fail_at: int, number: int) -> None:
        """Restart the count; fail from step `fail_at` on with the error `number`, or never if `fail_at` is 0."""
        self.count, self.fail_at, self.number = 0, fail_at, number


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(tmp_path, monkeypatch)
