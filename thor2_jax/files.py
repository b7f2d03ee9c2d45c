"""Writing files so that they appear under their name whole or not at all."""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError

__all__ = ["check_new", "json_digest", "replacing", "write_text"]


def check_new(path: str | Path) -> None:
    """Refuse a folder to write to whose name is taken, by anything but an empty folder: nothing is overwritten.

    Raises:
        InputError: naming the path.
    """
    path = Path(path)
    if path.is_symlink() or (path.exists() and not (path.is_dir() and not any(path.iterdir()))):
        raise InputError(f"out: {path} exists already and is not an empty folder")


def json_digest(table: Mapping[str, Any]) -> str:
    """SHA-256, in hexadecimal, of what a JSON table says but for its own "digest", however it is laid out.

    A changed number reads as well as the right one; its digest tells.
    """
    said = {key: value for key, value in table.items() if key != "digest"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; renamed to it on success, removed on any failure.

    Raises:
        OSError: the folder does not exist or cannot be written.
    """
    path = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    try:
        yield Path(name)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def write_text(path: str | Path, text: str) -> None:
    """Write `text` in UTF-8."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
