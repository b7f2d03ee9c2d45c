"""What readers share about files: tables in JSON and YAML, and complaints that name the frame."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from thor2_jax.errors import InputError

__all__ = ["complaints_about", "read_table"]


@contextlib.contextmanager
def complaints_about(identifier: str) -> Iterator[None]:
    """Put `identifier` before what an InputError says, and make one of a file that is missing."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{identifier}: {error.filename} is missing") from None
    except InputError as error:
        raise InputError(f"{identifier}: {error}") from None


def read_table(path: Path) -> dict[Any, Any]:
    """Read a file that holds one table: JSON if its name ends in .json, YAML otherwise.

    Raises:
        InputError: damaged, or something else than a table; names the file.
        OSError: it cannot be opened.
    """
    content = path.read_bytes()
    try:
        table = json.loads(content) if path.suffix.lower() == ".json" else yaml.safe_load(content)
    # The constructors of YAML's tags raise several kinds of exception; only the content is at work here.
    except (ValueError, yaml.YAMLError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({' '.join(str(error).split())})") from None
    if not isinstance(table, dict):
        raise InputError(f"{path} holds a {type(table).__name__}; expected a table")
    return table
