"""Samples of distractors in the user's cache: all runs use the same ones, and rendering them takes minutes.

Each file holds the samples of one record of everything that determines them, and is named by the record's digest.
"""

import contextlib
import json
import logging
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import safetensors.numpy

import thor2_jax
import training
from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, content_digest, json_digest, remove_leftovers, safetensors_metadata
from training.embedding.samples import Samples
from training.storage.locks import locked
from training.storage.user_cache import cache_directory, processor

__all__ = ["cached_samples"]

MAX_FILES = 3
"""Number of files that are kept; the ones that were used last."""

FORMAT = "thor2 samples of distractors, 1"
NAME = re.compile(r"distractors-[0-9a-f]{64}\.safetensors")

CODE = ("augmentation", "embedding", "objects", "rendering", "views")
LIBRARY_CODE = (".", "descriptor", "frames")
"""Packages of training and of the library whose code determines the samples."""

log = logging.getLogger(__name__)


def cached_samples(job: Mapping[str, Any], build: Callable[[], Samples], resumes: bool = False) -> Samples:
    """Return samples from the cache, or build them and store them there.

    A cache that cannot be used costs the time to build the samples, and is logged as a warning.

    Args:
        job: record of everything that determines the samples beside the software and the kind of processor.
        build: returns the samples.
        resumes: whether `build` resumes an interrupted sampling, which is then not replaced by samples of the cache.

    Raises:
        InputError: THOR2_CACHE names a file; or as `build`.
        OSError: as `build`.
    """
    directory = cache_directory("distractors")
    if directory is None:
        return build()
    file = directory / f"distractors-{json_digest({**job, **_software()})}.safetensors"
    try:
        if not resumes and file.is_file():
            samples = _read(file)
            with contextlib.suppress(OSError):  # a read-only cache is used as it is
                os.utime(file)
            return samples
    except (OSError, ValueError, KeyError, TypeError, AttributeError, safetensors.SafetensorError) as error:
        log.warning(
            "%s cannot be used (%s); the distractors are rendered again%s",
            file,
            error,
            "" if _is_own(file) else "; delete this file",
        )
    samples = build()
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
        with locked(directory):
            remove_leftovers(directory)
            if not file.exists() or _is_own(file):
                _write(file, samples)
            own = [path for path in directory.iterdir() if _is_own(path)]
            for path in sorted(own, key=lambda path: path.stat().st_mtime, reverse=True)[MAX_FILES:]:
                path.unlink(missing_ok=True)
    except InputError:
        pass  # another process is writing, usually the same file
    except OSError as error:
        log.warning("the distractors cannot be kept for the next training: %s", error)
    return samples


def _software() -> dict[str, str]:
    """Return the record of the software: users of a checkout change code within a version."""
    root = Path(training.__file__).parent
    folders = [root / package for package in CODE] + [Path(thor2_jax.__file__).parent / each for each in LIBRARY_CODE]
    files = (file for folder in folders for file in sorted(folder.glob("*.py")))
    return {
        "version": thor2_jax.__version__,
        "code": content_digest(file.read_bytes() for file in files),
        "platform": f"{jax.default_backend()} {processor()}",
    }


def _content(arrays: Mapping[str, Any]) -> str:
    return content_digest(part for name in sorted(arrays) for part in (name, arrays[name].tobytes()))


def _write(file: Path, samples: Samples) -> None:
    arrays = {name: value for name, value in vars(samples).items() if name != "shape"}
    metadata = {"format": FORMAT, "shape": json.dumps(samples.shape), "sha256": _content(arrays)}
    with atomic_write(file) as temporary:
        temporary.write_bytes(safetensors.numpy.save(arrays, metadata))


def _read(file: Path) -> Samples:
    """Read samples; raises ValueError, KeyError, TypeError or SafetensorError if the file is damaged."""
    metadata = _metadata(file)
    if metadata["format"] != FORMAT:
        raise ValueError(f"its format is {metadata['format']!r}; expected {FORMAT!r}")
    arrays = safetensors.numpy.load(file.read_bytes())
    if metadata["sha256"] != _content(arrays):
        raise ValueError("its content is damaged")
    return Samples(shape=tuple(json.loads(metadata["shape"])), **arrays)


def _metadata(file: Path) -> dict[str, str]:
    """Return the metadata of a file that may be damaged behind its header."""
    with file.open("rb") as stream:
        return safetensors_metadata(stream.read(2**16))


def _is_own(path: Path) -> bool:
    """Return whether a file is one of the cache, by name and content, and may be replaced or removed."""
    try:
        is_file = NAME.fullmatch(path.name) is not None and path.is_file() and not path.is_symlink()
        return is_file and _metadata(path)["format"].startswith(FORMAT.split(",")[0])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False
