"""One process at a time in a folder that is in the making."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path

from thor2_jax.errors import InputError

__all__ = ["LOCK", "locked"]

LOCK = ".lock"


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to the folder. The lock ends with this process, however that ends.

    Raises:
        InputError: another process has it.
        OSError: the folder does not exist or cannot be written.
    """
    with (folder / LOCK).open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"out: another process is writing to {folder}") from None
        yield
