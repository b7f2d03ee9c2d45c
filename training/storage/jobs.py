"""Long jobs: records of their output directories, stored arrays for resuming, progress, and the cache.

The user's cache directory may be deleted at any time. The environment variable THOR2_CACHE sets another directory, or
`off` disables the cache.
"""

import itertools
import json
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from numpy.typing import NDArray

from thor2_jax.errors import InputError, decoding
from thor2_jax.files import content_digest, pack_arrays, read_file, unpack_arrays, write_bytes, write_text

__all__ = [
    "MANIFEST",
    "Progress",
    "add_prefix",
    "begin_job",
    "cache_directory",
    "check_begun",
    "check_same_job",
    "intact_content",
    "load_arrays",
    "numbered",
    "of_stage",
    "processor",
    "save_arrays",
    "write_checked",
]

VARIABLE = "THOR2_CACHE"


def cache_directory(kind: str) -> Path | None:
    """Return the directory for files of a kind, which may not exist yet; None without a cache or a home directory.

    With THOR2_CACHE, all kinds share one directory, since their file names differ.

    Raises:
        InputError: THOR2_CACHE names a file.
    """
    if (value := os.environ.get(VARIABLE, "")) == "off":
        return None
    try:
        directory = Path(value).expanduser() if value else platformdirs.user_cache_path("thor2-jax") / kind
    except RuntimeError:  # a user without a home directory
        return None
    if os.path.exists(directory) and not directory.is_dir():  # False if it cannot be accessed
        raise InputError(f"{VARIABLE} is {directory}, a file; expected a directory, or off")
    return directory


def processor() -> str:
    """Return a name for the kind of processor; programs compiled for another kind may crash or round differently."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        features = platform.processor()
    return f"{platform.machine()}-{content_digest([features])[:12]}"


Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""


def of_stage(progress: Progress, stage: str, note: str = "") -> Callable[[int, int], Any]:
    """Return the callback of a stage with a fixed note, called with (done, total)."""
    return lambda done, total: progress(stage, done, total, note)


def add_prefix(progress: Progress, name: str) -> Progress:
    """Return a callback that prefixes the name of each stage."""
    return lambda stage, done, total, note: progress(f"{name}: {stage}", done, total, note)


def numbered(progress: Progress, stages: Mapping[str, float]) -> Progress:
    """Return a callback that adds "stage k of n" to the name of each stage, and the remaining total time to its note.

    The estimate uses the pace of all progress so far. Work that was done before a stage was resumed is not counted.

    Args:
        progress: the callback to call with the extended name and note.
        stages: name -> expected time in any unit, or 0 if it is not known, in the order of the stages. Other stages are
            passed on unchanged.
    """
    names = {stage: f"stage {number} of {len(stages)}: {stage}" for number, stage in enumerate(stages, 1)}
    earlier = dict(zip(stages, itertools.accumulate(stages.values(), initial=0.0), strict=False))
    seconds, made, last = 0.0, 0.0, ("", 0.0, 0.0)

    def show(stage: str, done: int, total: int, note: str) -> None:
        nonlocal seconds, made, last
        if stages.get(stage):
            now, part = time.monotonic(), earlier[stage] + stages[stage] * done / max(total, 1)
            if stage == last[0]:
                seconds, made = seconds + now - last[1], made + part - last[2]
            last = stage, now, part
            left = seconds * (sum(stages.values()) - part) / made if made > 0 else 0.0
            if seconds >= 1 and left >= 1:
                note = ", ".join(filter(None, (note, f"about {left:.0f} s left of all stages")))
        progress(names.get(stage, stage), done, total, note)

    return show


JOB_FILE = "job.json"

MAX_SHOWN = 100
"""Largest number of characters of a value that an error message shows."""


def begin_job(directory: Path, job: Mapping[str, Any], name: str = JOB_FILE) -> None:
    """Write the record of a job to a directory, or check that the directory belongs to this job.

    Args:
        directory: output directory; it is created unless it exists.
        job: the record, in JSON types.
        name: path of the record in the directory.

    Raises:
        InputError: the directory belongs to another job, or its record is damaged.
        OSError: the record cannot be written.
    """
    check_begun(directory, job, name)
    if not (file := directory / name).is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_text(file, json.dumps(job, indent=1) + "\n")


def check_begun(directory: Path, job: Mapping[str, Any], name: str = JOB_FILE) -> None:
    """Raise InputError if a directory has a damaged record or the record of another job; arguments as `begin_job`."""
    if (file := directory / name).is_file():
        with decoding(f"out: {file} cannot be read", advice=f"delete {file.parent} to start anew"):
            begun = dict(json.loads(file.read_bytes()))
        check_same_job(directory, begun, job)


def check_same_job(directory: Path, stored: Mapping[str, Any], requested: Mapping[str, Any]) -> None:
    """Check that an output directory was written by the requested job.

    Args:
        directory: output directory.
        stored: record of the job that wrote it, as read from JSON.
        requested: record of the job to run, in JSON types.

    Raises:
        InputError: the records differ; the message names the first different field and both values.
    """
    if difference := next(_differences("", stored, json.loads(json.dumps(requested))), None):
        field, old, new = difference
        raise InputError(
            f"out: {directory} was written with {field} {_shown(old)}, not {_shown(new)}; "
            "repeat the command with the same options and unchanged files, or choose another directory"
        )


def _differences(field: str, stored: Any, requested: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the path of each different field and both values; a missing value is None."""
    if isinstance(stored, Mapping) and isinstance(requested, Mapping):
        for key in dict.fromkeys([*requested, *stored]):
            yield from _differences(f"{field}.{key}" if field else key, stored.get(key), requested.get(key))
    elif isinstance(stored, list) and isinstance(requested, list):
        for index, pair in enumerate(itertools.zip_longest(stored, requested)):
            yield from _differences(f"{field}[{index}]", *pair)
    elif stored != requested:
        yield field, stored, requested


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


MANIFEST = "manifest.json"
"""List of the finished files in an output directory, with their checksums."""


def write_checked(path: Path, content: bytes) -> str:
    """Write a file and return its SHA-256.

    Raises:
        OSError: the file cannot be written; an older file is kept.
    """
    write_bytes(path, content)
    return content_digest([content])


def intact_content(directory: Path, name: str, sha256: str) -> bytes | None:
    """Return the bytes of a file; None if it is missing or has another checksum."""
    path = directory / name
    content = path.read_bytes() if path.is_file() else b""
    return content if content_digest([content]) == sha256 else None


Arrays = Mapping[str, NDArray[Any]]


def _arrays_digest(arrays: Arrays) -> str:
    return content_digest(part for name in sorted(arrays) for part in (name, np.asarray(arrays[name]).tobytes()))


def save_arrays(path: Path, arrays: Arrays, metadata: Mapping[str, str]) -> None:
    """Write arrays and metadata to a safetensors file.

    Raises:
        OSError: the file cannot be written; an older file is kept.
    """
    write_bytes(path, pack_arrays(arrays, {**metadata, "sha256": _arrays_digest(arrays)}))


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is damaged.
    """
    arrays, metadata = unpack_arrays(read_file(path))
    if _arrays_digest(arrays) != metadata.get("sha256"):
        raise ValueError("its content is damaged")
    return arrays
