"""The cache of compiled programs: kept in the user's cache directory, so that only the first run of a command compiles.

The environment variable THOR2_CACHE names another directory, or is `off`. JAX_COMPILATION_CACHE_DIR takes precedence.
The directory may be deleted at any time.
"""

import hashlib
import os
import platform
import warnings
from pathlib import Path

import platformdirs

from thor2_jax.errors import InputError

__all__ = ["VARIABLE", "enable_compilation_cache"]

VARIABLE = "THOR2_CACHE"
MAX_BYTES = 2**30


def enable_compilation_cache() -> None:
    """Set the environment variables that JAX reads when it is imported; without a writable directory, set none.

    Raises:
        InputError: THOR2_CACHE names a file.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA logs each program of the cache as an error
    value = os.environ.get(VARIABLE, "")
    if value == "off" or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    root = Path(value) if value else platformdirs.user_cache_path("thor2-jax") / "xla"
    if root.exists() and not root.is_dir():
        raise InputError(f"{VARIABLE} is {root}, a file; expected a directory, or off")
    directory = root / _processor()
    try:
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    if os.access(directory, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(directory)
        os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(MAX_BYTES))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        # A damaged entry, or a full disk, costs a compilation and nothing else.
        warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")


def _processor() -> str:
    """Return a name for the kind of processor: a program compiled for another one may crash."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features = next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        features = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:12]}"
