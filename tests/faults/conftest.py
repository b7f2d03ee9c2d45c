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
    """Count the write operations under a directory, and fail from the n-th on, like a full disk.

    Opening for writing, writing, creating a directory and renaming each count once. Removing never fails.
    """

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.count, self.fail_at = str(folder), 0, 0
        for module in (builtins, io):
            patch.setattr(module, "open", self._opening(module.open))
        for name in ("mkdir", "rename", "replace"):
            patch.setattr(os, name, self._failing(getattr(os, name)))
        patch.setattr(os, "open", self._failing(os.open, lambda flags, *_: flags & os.O_CREAT))

    def step(self, path: Any) -> None:
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(self.folder):
            self.count += 1
            if self.fail_at and self.count >= self.fail_at:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(path))

    def _failing(self, function: Callable[..., Any], writes: Any = lambda *_: True) -> Callable[..., Any]:
        def wrapper(path: Any, *rest: Any, **more: Any) -> Any:
            if writes(*rest):
                self.step(path)
            return function(path, *rest, **more)

        return wrapper

    def _opening(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(path: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
            if not set(mode) & set("wxa+") or not isinstance(path, (str, os.PathLike)):
                return function(path, mode, *rest, **more)
            self.step(path)
            stream = function(path, mode, *rest, **more)
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

    def fail_from(self, step: int) -> None:
        """Restart the count; fail from a step on, or never if it is 0."""
        self.count, self.fail_at = 0, step


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(tmp_path, monkeypatch)
