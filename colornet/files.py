"""Atomic writes, and files of named arrays."""

import contextlib
import io
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["atomic_write", "errors_name", "read_arrays", "remove_leftovers", "write_arrays"]

MAX_ARRAY_BYTES = 2**26
"""Largest total size of the arrays in a file; compressed zeros need only a thousandth of it on disk."""


_TEMPORARY = re.compile(r"\..+\.[a-z0-9_]{8}(\.\w+)?")


@contextlib.contextmanager
def errors_name(path: str | Path) -> Iterator[None]:
    """Name `path` in an OSError raised inside: a write to a full disk names no file.

    Raises:
        OSError: with the file's name.
    """
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file beside `path` to write to; on success it replaces `path`, readable by everyone.

    On any error or interrupt the temporary file is removed, and an older file at `path` stays as it was. A process that
    is killed leaves it, see `remove_leftovers`.

    Raises:
        OSError: the folder does not exist or cannot be written; it names `path`.
    """
    path = Path(path)
    with errors_name(path):
        descriptor, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
        os.close(descriptor)
        temporary = Path(name)
        try:
            yield temporary
            temporary.chmod(0o644)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def remove_leftovers(directory: Path) -> None:
    """Remove the temporary files of `atomic_write` that a killed process has left in a directory, if it exists."""
    for path in directory.glob(".*.*"):
        if _TEMPORARY.fullmatch(path.name):
            path.unlink(missing_ok=True)


def write_arrays(path: str | Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays to `path` (npz), compressed and atomically; equal arrays give equal bytes.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **dict[str, Any](arrays))


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the arrays that `write_arrays` wrote.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is damaged or is not a file of arrays.
    """
    data = Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > MAX_ARRAY_BYTES:
                raise ValueError("its arrays are too large")
            arrays = {name: archive[name] for name in archive.files}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("a member is not an array")
        return arrays
    # For damaged bytes zipfile, zlib and NumPy raise a dozen kinds of exceptions; nothing else can fail here.
    except Exception as error:
        raise ValueError(f"{path} is damaged or not a file of arrays (npz)") from error
