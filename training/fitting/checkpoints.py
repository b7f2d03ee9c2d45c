"""Checkpoints of one fit, from which an interrupted fit resumes; the only module that uses orbax's managers.

    with Checkpoints(directory) as checkpoints:
        state = checkpoints.last(state) if checkpoints.last_epoch else state
        for epoch in range(checkpoints.last_epoch + 1, epochs + 1):
            ...
            checkpoints.save(epoch, state, score)
        state = checkpoints.best(state)

Two epochs are kept: the last one and the one with the best score. A checkpoint is written atomically, and an older one
is removed only afterwards, so the last complete checkpoint survives any crash.
"""

import contextlib
import logging
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp  # type: ignore[import-untyped]
from orbax.checkpoint import checkpoint_managers

from thor2_jax.errors import InputError
from thor2_jax.files import directory_digest, write_text
from thor2_jax.model.run_record import RUN_FILE

__all__ = ["BEGUN", "CHECKPOINTS", "Checkpoints", "find_run_directories"]

CHECKPOINTS = "checkpoints"
"""Directory inside the run directory of an unfinished training."""

BEGUN = "begun.json"
"""Job record of an unfinished training in this directory."""

DIGEST_FILE = "sha256"


class Checkpoints(contextlib.AbstractContextManager["Checkpoints"]):
    """Checkpoints in one directory, which all processes of a training share."""

    def __init__(self, directory: str | Path) -> None:
        """Open or create the directory, and remove incomplete checkpoints from it.

        Raises:
            OSError: if the directory cannot be created.
        """
        self.directory = Path(directory).absolute()
        self.directory.mkdir(parents=True, exist_ok=True)
        keep = checkpoint_managers.AnyPreservationPolicy(
            [checkpoint_managers.LatestN(1), checkpoint_managers.BestN(get_metric_fn=_score, n=1)]
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=keep, best_fn=_score, cleanup_tmp_directories=True, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager(self.directory, options=options)

    def __exit__(self, *_: object) -> None:
        self._manager.close()

    @property
    def last_epoch(self) -> int:
        """Epoch of the last checkpoint; 0 if there is none."""
        return int(self._manager.latest_step() or 0)

    @property
    def best_epoch(self) -> int:
        """Epoch of the checkpoint with the highest score, the latest of equal ones; 0 if there is none."""
        return int(self._manager.best_step() or 0)

    def save(self, epoch: int, state: Any, score: float) -> None:
        """Write a checkpoint.

        Args:
            epoch: number of the epoch, greater than that of the last checkpoint.
            state: pytree of arrays, equal in all processes.
            score: quality of the state; higher is better.

        Raises:
            OSError: if the checkpoint cannot be written, for example because the disk is full.
        """
        host = _storable(jax.tree.map(np.asarray, state))
        try:
            with _quiet_orbax():
                self._manager.save(epoch, args=ocp.args.StandardSave(host), metrics={"score": score})
            if jax.process_index() == 0:
                write_text(self._path(epoch) / DIGEST_FILE, directory_digest(self._path(epoch) / "default"))
        except Exception as error:  # orbax passes on all exceptions of its storage layers
            number, reason = _system_error(error)
            message = f"the checkpoint of epoch {epoch} cannot be written: {reason}"
            raise OSError(number, message, str(self.directory)) from None

    def last(self, like: Any) -> Any:
        """Return the state of the last checkpoint, as NumPy arrays.

        Args:
            like: state of the same structure, shapes and dtypes.

        Raises:
            InputError: if the checkpoint is damaged or has another structure.
        """
        return self._restore(self.last_epoch, like)

    def best(self, like: Any) -> Any:
        """Return the state of the checkpoint with the highest score, like `last`."""
        return self._restore(self.best_epoch, like)

    def _path(self, epoch: int) -> Path:
        return self.directory / str(epoch)

    def _restore(self, epoch: int, like: Any) -> Any:
        path = self._path(epoch)
        target = jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), like)
        try:
            # A process that is killed between checkpoint and digest leaves no digest.
            digest = path / DIGEST_FILE
            if digest.is_file() and digest.read_text() != directory_digest(path / "default"):
                raise ValueError("it is damaged")
            with _quiet_orbax():
                state = self._manager.restore(epoch, args=ocp.args.StandardRestore(_storable(target)))
            state = jax.tree.map(lambda leaf, expected: leaf if expected.size else expected, state, target)
            for leaf, expected in zip(jax.tree.leaves(state), jax.tree.leaves(target), strict=True):
                if (leaf.shape, leaf.dtype) != (expected.shape, expected.dtype):
                    raise ValueError(f"it has {leaf.dtype} {leaf.shape}; expected {expected.dtype} {expected.shape}")
        except Exception as error:  # orbax passes on all exceptions of its storage layers
            raise InputError(
                f"checkpoint: {path} cannot be read ({_first_line(error)}); remove {self.directory} to restart this fit"
            ) from None
        return state


def _storable(state: Any) -> Any:
    """Return a state with an element in each empty array, which orbax does not store."""
    return jax.tree.map(lambda a: a if a.size else np.zeros(1, a.dtype), state)


def _score(metrics: dict[str, float]) -> float:
    return metrics["score"]


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


def _system_error(error: Exception) -> tuple[int | None, str]:
    """Return the system's error number and message, from an OSError or from the text of tensorstore's error."""
    match = re.search(r"os_error_code='(\d+)'", str(error))
    number = error.errno if isinstance(error, OSError) else int(match[1]) if match else None
    return number, os.strerror(number) if number else _first_line(error)


@contextlib.contextmanager
def _quiet_orbax() -> Iterator[None]:
    """Suppress the tracebacks that orbax's threads log or print for errors that are raised anyway.

    After an error, its threads find their event loop closed, also later; that message stays suppressed.
    """
    logger, hook = logging.getLogger("absl"), sys.excepthook

    def print_others(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if not (kind is RuntimeError and str(error) == "Event loop is closed"):
            hook(kind, error, traceback)

    before, logger.disabled, sys.excepthook = logger.disabled, True, print_others
    try:
        yield
        sys.excepthook = hook
    finally:
        logger.disabled = before


def find_run_directories(paths: Iterable[Path]) -> list[Path]:
    """Return the run directories among `paths`; a directory with fold-0, fold-1, ... is replaced by its folds.

    Raises:
        InputError: A training is not finished. A path that is not a run directory is refused when it is loaded.
    """
    directories: list[Path] = []
    for path in map(Path, paths):
        folds = [f.parent for f in path.glob(f"fold-*/{RUN_FILE}") if f.parent.name[5:].isdecimal()]
        if (path / RUN_FILE).is_file() or not folds:
            directories.append(path)
        elif (path / CHECKPOINTS / BEGUN).exists():
            raise InputError(
                f"model: {path} holds an unfinished training; finish it with `thor2 train`, or give single folds of it"
            )
        else:
            directories += sorted(folds, key=lambda fold: int(fold.name[5:]))
    return directories
