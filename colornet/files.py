"""Atomic writes, and files of named arrays."""

import contextlib
import errno
import fcntl
import io
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "PREFIX",
    "atomic_write",
    "check_replaceable",
    "errors_name",
    "open_file",
    "read_arrays",
    "read_file",
    "remove_leftovers",
    "temporary_directory",
]

MAX_ARRAY_BYTES = 2**26
"""Largest total size of the arrays in a file; compressed zeros take only a thousandth of this on disk."""


PREFIX = ".thor2-"
"""Beginning of the names of temporary directories."""

_MARKER, _MARKER_TEXT = ".thor2", b"Temporary directory of thor2. The next command removes it with all that is in it.\n"


@contextlib.contextmanager
def errors_name(path: str | Path) -> Iterator[None]:
    """Add `path` to an OSError raised inside, since a failed write to a full disk names no file.

    Raises:
        OSError: the original error, with the file's name.
    """
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def _check_path(path: str | Path) -> None:
    if "\0" in str(path):  # Python would raise a ValueError that does not name the path
        raise OSError(errno.EINVAL, "a path with a null character", str(path))


def open_file(path: str | Path) -> BinaryIO:
    """Open a file to read; raise OSError for a device, pipe or socket, too, since reading it may never end."""
    _check_path(path)
    stream = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        stream.close()
        raise OSError(errno.EINVAL, "a device, pipe or socket; expected a file", str(path))
    return stream


def read_file(path: str | Path) -> bytes:
    """Return the content of a file; raise OSError as `open_file`."""
    with open_file(path) as stream:
        return stream.read()


def check_replaceable(path: Path) -> None:
    """Raise OSError if something other than a file has this name, since replacing a device would remove it."""
    _check_path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, "a device, pipe or socket, which would be replaced", str(path))


@contextlib.contextmanager
def temporary_directory(parent: str | Path) -> Iterator[Path]:
    """Remove leftovers of killed processes in `parent`, then yield a new hidden directory there; remove it at the end.

    The directory is identified by its name and by a file in it that is locked during use, see `remove_leftovers`.
    """
    remove_leftovers(Path(parent))
    directory = Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent))
    try:
        with open(directory / _MARKER, "wb", buffering=0) as marker:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(marker, fcntl.LOCK_EX)
            marker.write(_MARKER_TEXT)
            yield directory
    finally:
        _remove_temporary(directory)


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary file to write to; on success it replaces `path`, readable by everyone.

    On any error or interrupt, the temporary file is removed, and an older file at `path` is unchanged.

    Raises:
        OSError: the parent directory does not exist or cannot be written, or a directory, device, pipe or socket has
            this name; the error names `path`.
    """
    path = Path(path)
    with errors_name(path):
        check_replaceable(path)
        with temporary_directory(path.parent) as directory:
            temporary = directory / path.name
            yield temporary
            temporary.chmod(0o644)
            temporary.replace(path)


def remove_leftovers(directory: Path) -> None:
    """Remove the temporary directories that killed processes have left in a directory, if it exists.

    Directories in use and all other files stay, whatever their names.
    """
    for path in directory.glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):  # owned by another user, or in use
            if not path.is_symlink() and (path / _MARKER).is_file():
                with open(path / _MARKER, "r+b") as marker:  # network file systems only lock files open for writing
                    fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    is_left = marker.read() == _MARKER_TEXT
                if is_left:  # remove it after closing the file, which network file systems would rename
                    _remove_temporary(path)


def _remove_temporary(directory: Path) -> None:
    """Remove a temporary directory; its marker, which identifies what a killed process leaves, after subdirectories."""
    for path in (*directory.glob("*"), directory):
        shutil.rmtree(path, ignore_errors=True)


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read the arrays of an npz file.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is damaged or is not a file of arrays.
    """
    data = read_file(path)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > MAX_ARRAY_BYTES:
                raise ValueError("its arrays are too large")
            arrays = {name: archive[name] for name in archive.files}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("a member is not an array")
        return arrays
    # For damaged bytes, zipfile, zlib and NumPy raise a dozen kinds of exceptions; nothing else can fail here.
    except Exception as error:
        raise ValueError(f"{path} is damaged or not a file of arrays (npz)") from error
