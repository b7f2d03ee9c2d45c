"""Files of named arrays with a checksum, which are written atomically: checkpoints, and samples in the user's cache."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from thor2_jax.files import atomic_write, content_digest

__all__ = ["load_arrays", "load_metadata", "save_arrays"]

Arrays = Mapping[str, NDArray[Any]]


def save_arrays(path: Path, arrays: Arrays, metadata: Mapping[str, str]) -> None:
    """Write arrays and metadata to a safetensors file.

    Raises:
        OSError: the file cannot be written; an older one stays.
    """
    with atomic_write(path) as temporary:
        safetensors.numpy.save_file(dict(arrays), temporary, {**metadata, "sha256": _digest(arrays)})


def load_metadata(path: Path) -> dict[str, str]:
    """Return the metadata of a file; only its header is read.

    Raises:
        ValueError: the file is missing, or its header or its size is damaged.
    """
    try:
        with safetensors.safe_open(path, "numpy") as file:
            return dict(file.metadata() or {})
    except (OSError, safetensors.SafetensorError) as error:
        raise ValueError(str(error)) from None


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file.

    Raises:
        ValueError: the file is missing or damaged.
    """
    checksum = load_metadata(path).get("sha256")
    arrays = safetensors.numpy.load_file(path)
    if _digest(arrays) != checksum:
        raise ValueError("its content is damaged")
    return arrays


def _digest(arrays: Arrays) -> str:
    return content_digest(part for name in sorted(arrays) for part in (name, arrays[name].tobytes()))
