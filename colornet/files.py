"""Files: written whole or not at all, and read with damage told in one line."""

import contextlib
import io
import uuid
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["read_arrays", "whole_file", "write_arrays"]

MOST_BYTES = 2**26
"""Of arrays that are read: zeros take up a thousandth in the file."""


@contextlib.contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Context that yields a temporary name beside `path`, and on success gives what was written there the name `path`.

    On an error nothing is left behind, and a file that `path` had before stays as it was.

    Raises:
        OSError: the file cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_arrays(path: str | Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write named arrays to `path` (npz), compressed; equal arrays give equal bytes.

    Raises:
        OSError: the file cannot be written.
    """
    with whole_file(path) as temporary, open(temporary, "xb") as stream:
        np.savez_compressed(stream, **dict[str, Any](arrays))


def read_arrays(path: str | Path) -> dict[str, NDArray[Any]]:
    """Read what `write_arrays` wrote.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no such file, or is damaged.
    """
    data = Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > MOST_BYTES:
                raise ValueError("its arrays would fill memory")
            arrays = {name: archive[name] for name in archive.files}
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("a member is no array")
        return arrays
    # Damaged bytes make zipfile, zlib and NumPy raise a dozen kinds of exception; nothing but bytes is at work here.
    except Exception as error:
        raise ValueError(f"{path} is damaged or not a file of arrays (npz)") from error
