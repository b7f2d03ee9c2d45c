"""The user's cache directory, which may be deleted at any time.

The environment variable THOR2_CACHE names another directory, or is `off`.
"""

import hashlib
import os
import platform
from pathlib import Path

import platformdirs

from thor2_jax.errors import InputError

__all__ = ["VARIABLE", "cache_directory", "processor"]

VARIABLE = "THOR2_CACHE"


def cache_directory(kind: str) -> Path | None:
    """Return the directory for files of a kind, which may be missing; None if there is no cache.

    THOR2_CACHE holds the files of all kinds, which have different names.

    Raises:
        InputError: THOR2_CACHE names a file.
    """
    value = os.environ.get(VARIABLE, "")
    if value == "off":
        return None
    directory = Path(value) if value else platformdirs.user_cache_path("thor2-jax") / kind
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{VARIABLE} is {directory}, a file; expected a directory, or off")
    return directory


def processor() -> str:
    """Return a name for the kind of processor: a program compiled for another one may crash or round otherwise."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        features = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"
