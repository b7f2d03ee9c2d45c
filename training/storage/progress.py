"""The progress callback of long jobs."""

from collections.abc import Callable

__all__ = ["Progress"]

Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""
