"""The cache of compiled programs: kept in the user's cache directory, so that only the first run of a command compiles.

`training.storage.user_cache` describes the directory. JAX_COMPILATION_CACHE_DIR takes precedence.
"""

import os
import warnings

from training.storage.user_cache import cache_directory, processor

__all__ = ["enable_compilation_cache"]

MAX_BYTES = 2**30


def enable_compilation_cache() -> None:
    """Set the environment variables that JAX reads when it is imported; without a writable directory, set none.

    Raises:
        InputError: THOR2_CACHE names a file.
    """
    root = cache_directory("xla")
    if root is None or os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    directory = root / processor()
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
