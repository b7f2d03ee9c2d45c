"""Files of named arrays with a checksum, which are written atomically: checkpoints, and samples in the user's cache."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.files import atomic_write, content_digest, pack_arrays, read_file, safetensors_metadata, unpack_arrays

__all__ = ["load_arrays", "load_metadata", "save_arrays"]

Arrays = Mapping[str, NDArray[Any]]


def save_arrays(path: Path, arrays: Arrays, metadata: Mapping[str, str]) -> None:
    """Write arrays and metadata to a safetensors file.

    Raises:
        OSError: the file cannot be written; an older one stays.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(pack_arrays(arrays, {**metadata, "sha256": _digest(arrays)}))


def load_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a file, which may be damaged behind its header.

    Raises:
        ValueError: the file is missing, or its header is damaged.
    """
    try:
        with path.open("rb") as stream:
            return safetensors_metadata(stream.read(2**20))
    except (OSError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(str(error)) from None


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file.

    Raises:
        ValueError: the file is missing or damaged.
    """
    try:
        arrays, metadata = unpack_arrays(read_file(path))
    except OSError as error:
        raise ValueError(str(error)) from None
    if _digest(arrays) != metadata.get("sha256"):
        raise ValueError("its content is damaged")
    return arrays


def _digest(arrays: Arrays) -> str:
    return content_digest(part for name in sorted(arrays) for part in (name, np.asarray(arrays[name]).tobytes()))
