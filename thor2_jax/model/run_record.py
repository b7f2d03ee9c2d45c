"""The description of a run, run.json, and where runs are; this module does not import JAX."""

from pathlib import Path
from typing import Any

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.errors import InputError
from thor2_jax.files import parse_json, read_file

__all__ = ["FORMAT_WITH_SURFACES", "RUN_FILE", "RUN_FORMAT", "read_description", "run_directories"]

RUN_FORMAT, FORMAT_WITH_SURFACES = 2, 3
"""Versions of the layout, see `run_directory`. Format 1, of versions before 0.2, cannot be read."""

RUN_FILE = "run.json"


def run_directories(path: Path) -> list[Path]:
    """Return the path of a run directory, or those of fold-0, fold-1, ... in it; an empty list if there are neither."""
    if (path / RUN_FILE).is_file():
        return [path]
    folds = [file.parent for file in path.glob(f"fold-*/{RUN_FILE}") if file.parent.name[5:].isdecimal()]
    return sorted(folds, key=lambda fold: int(fold.name[5:]))


def read_description(path: Path) -> dict[str, Any]:
    """Return the content of run.json in a run directory.

    Raises:
        InputError: the path is not a run directory, or its format or descriptor version is not supported.
    """
    try:
        description = parse_json(read_file(path / RUN_FILE))
    except FileNotFoundError:
        fold = "".join(f", such as {run}" for run in run_directories(path)[:1])
        raise InputError(f"model: {path} is not a run directory; expected one with run.json{fold}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"model: {path / RUN_FILE} cannot be read: {reason}") from None
    if not isinstance(description, dict) or description.get("format") not in (RUN_FORMAT, FORMAT_WITH_SURFACES):
        value = description.get("format") if isinstance(description, dict) else type(description).__name__
        expected = f"{RUN_FORMAT} or {FORMAT_WITH_SURFACES}"
        raise InputError(f"model: {path / RUN_FILE} has format {value!r}; expected {expected}; train it again")
    if description.get("descriptor_version") != DESCRIPTOR_VERSION:
        raise InputError(
            f"model: {path} was trained on descriptor version {description.get('descriptor_version')!r}; "
            f"this version computes {DESCRIPTOR_VERSION}; train it again"
        )
    classes = description.get("classes")
    if not isinstance(classes, list) or not all(isinstance(name, str) for name in classes):
        raise InputError(f"model: {path / RUN_FILE}: classes is {classes!r}; expected a list of names")
    return description
