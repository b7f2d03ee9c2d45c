"""Job records, which tell whether an output directory is that of the requested job, and exclusive locks on it."""

import itertools
import json
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import filelock

from thor2_jax.errors import InputError
from thor2_jax.files import write_text

__all__ = ["JOB_FILE", "LOCK", "begin_job", "check_begun", "check_same_job", "locked"]

JOB_FILE = "job.json"

MAX_SHOWN = 100
"""Characters of a value that an error message shows."""


def begin_job(directory: Path, job: Mapping[str, Any], name: str = JOB_FILE) -> None:
    """Write the record of a job to a directory, or check that the directory is of this job.

    Args:
        directory: output directory; it is created unless it exists.
        job: the record, as JSON can hold it.
        name: path of the record in the directory.

    Raises:
        InputError: the directory is of another job, or its record is damaged.
        OSError: the record cannot be written.
    """
    check_begun(directory, job, name)
    file = directory / name
    if not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, json.dumps(job, indent=1) + "\n")


def check_begun(directory: Path, job: Mapping[str, Any], name: str = JOB_FILE) -> None:
    """Raise InputError if a directory has the record of another job, or a damaged one; arguments as `begin_job`."""
    file = directory / name
    if file.is_file():
        try:
            begun = dict(json.loads(file.read_bytes()))
        except (OSError, ValueError, TypeError, RecursionError) as error:
            raise InputError(f"out: {file} cannot be read ({error}); delete {file.parent} to start anew") from None
        check_same_job(directory, begun, job)


def check_same_job(directory: Path, stored: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    """Raise if an output directory was written by another job than the requested one.

    Args:
        directory: output directory.
        stored: record of the job that wrote it, as read from JSON.
        requested: record of the job to run, as JSON can hold it.

    Raises:
        InputError: naming the first field that differs, with both values.
    """
    difference = _first_difference("", stored, json.loads(json.dumps(requested)))
    if difference:
        field, old, new = difference
        raise InputError(
            f"out: {directory} was written with {field} {_shown(old)}, not {_shown(new)}; "
            "repeat the command with the same options, or choose another directory"
        )


def _first_difference(field: str, stored: Any, requested: Any) -> tuple[str, Any, Any] | None:
    """Return the path of the first field that differs and both values; a missing value is None."""
    inner: list[tuple[str, Any, Any]] = []
    if isinstance(stored, Mapping) and isinstance(requested, Mapping):
        keys = dict.fromkeys([*requested, *stored])
        inner = [(f"{field}.{key}" if field else key, stored.get(key), requested.get(key)) for key in keys]
    elif isinstance(stored, list) and isinstance(requested, list):
        pairs = itertools.zip_longest(stored, requested)
        inner = [(f"{field}[{index}]", *pair) for index, pair in enumerate(pairs)]
    elif stored != requested:
        return field, stored, requested
    return next((difference for entry in inner if (difference := _first_difference(*entry))), None)


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


LOCK = ".lock"


def locked(directory: Path) -> AbstractContextManager[object]:
    """Acquire an exclusive lock on an output directory, which is created if it is missing; return its context.

    The operating system releases the lock when the process ends, even if it is killed. The lock file stays.

    Raises:
        InputError: if another process holds the lock.
        OSError: if the directory cannot be written, or its file system has no locks.
    """
    # A soft lock, filelock's fallback on file systems without locks, would outlive a killed process.
    try:
        return filelock.FileLock(directory / LOCK, blocking=False, fallback_to_soft=False).acquire()
    except filelock.Timeout:
        raise InputError(
            f"out: another process is writing to {directory}; wait until it ends, or choose another directory"
        ) from None
