"""Writing files so that they appear under their name whole or not at all."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from colornet.files import atomic_write
from thor2_jax.errors import InputError

__all__ = ["atomic_write", "check_new", "json_digest", "write_text"]


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


def write_text(path: str | Path, text: str) -> None:
    """Write `text` in UTF-8."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
