"""Exclusive locks on output directories."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import filelock

from thor2_jax.errors import InputError

__all__ = ["LOCK", "locked"]

LOCK = ".lock"


@contextlib.contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Hold an exclusive lock on an output directory, which is created if it is missing.

    The operating system releases the lock when the process ends, even if it is killed. The lock file stays.

    Raises:
        InputError: if another process holds the lock.
        OSError: if the directory cannot be written, or its file system has no locks.
    """
    # A soft lock, filelock's fallback on file systems without locks, would outlive a killed process.
    lock = filelock.FileLock(directory / LOCK, blocking=False, fallback_to_soft=False)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise InputError(
            f"out: another process is writing to {directory}; wait until it ends, or choose another directory"
        ) from None
    try:
        yield
    finally:
        lock.release()
