"""Checkpoints of one fit, so that it can go on where it was stopped (orbax stands behind this module).

    with Checkpoints(folder) as checkpoints:
        state = checkpoints.last(state) if checkpoints.last_epoch else state
        for epoch in range(checkpoints.last_epoch + 1, epochs + 1):
            ...
            checkpoints.save(epoch, state, score)
        state = checkpoints.best(state)

Two epochs are kept, the last one and the one with the best score. A checkpoint appears whole or not at all, and the one
before it goes only then: whatever happens, the last good one stays.
"""

import contextlib
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp  # type: ignore[import-untyped]
from orbax.checkpoint import checkpoint_managers

from thor2_jax.errors import InputError
from thor2_jax.files import directory_digest, write_text

__all__ = ["CHECKPOINTS", "Checkpoints"]

CHECKPOINTS = "checkpoints"
"""Folder of a run in the making."""

DIGEST = "sha256"


class Checkpoints:
    """A folder of checkpoints; with several processes, one that all of them see."""

    def __init__(self, folder: str | Path) -> None:
        """Open, or make, the folder, and clear away what a crash left unfinished.

        Raises:
            OSError: it cannot be made.
        """
        self.folder = Path(folder).absolute()
        self.folder.mkdir(parents=True, exist_ok=True)
        keep = checkpoint_managers.AnyPreservationPolicy(
            [checkpoint_managers.LatestN(1), checkpoint_managers.BestN(get_metric_fn=_score, n=1)]
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=keep, best_fn=_score, cleanup_tmp_directories=True, enable_async_checkpointing=False
        )
        self._manager = ocp.CheckpointManager(self.folder, options=options)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._manager.close()

    @property
    def last_epoch(self) -> int:
        """Of the last checkpoint; 0 if there is none."""
        return int(self._manager.latest_step() or 0)

    @property
    def best_epoch(self) -> int:
        """Of the checkpoint with the greatest score, the later one of equals; 0 if there is none."""
        return int(self._manager.best_step() or 0)

    def save(self, epoch: int, state: Any, score: float) -> None:
        """Write a checkpoint.

        Args:
            epoch: its number, greater than the last one's.
            state: pytree of arrays, the same in all processes.
            score: the greater, the better.

        Raises:
            OSError: it cannot be written, as when the disk is full.
        """
        host = jax.tree.map(np.asarray, state)
        try:
            with _no_tracebacks():
                self._manager.save(epoch, args=ocp.args.StandardSave(host), metrics={"score": score})
            if jax.process_index() == 0:
                write_text(self._path(epoch) / DIGEST, directory_digest(self._path(epoch) / "default"))
        except Exception as error:  # orbax raises whatever its storage layers raise
            number, why = _cause(error)
            raise OSError(
                number, f"the checkpoint of epoch {epoch} cannot be written: {why}", str(self.folder)
            ) from None

    def last(self, like: Any) -> Any:
        """The state of the last checkpoint, as host arrays.

        Args:
            like: a state of the same structure, shapes and types.

        Raises:
            InputError: it is damaged, or of another structure.
        """
        return self._restore(self.last_epoch, like)

    def best(self, like: Any) -> Any:
        """The state of the checkpoint with the greatest score; as `last`."""
        return self._restore(self.best_epoch, like)

    def _path(self, epoch: int) -> Path:
        return self.folder / str(epoch)

    def _restore(self, epoch: int, like: Any) -> Any:
        path = self._path(epoch)
        target = jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), like)
        try:
            # A process that was killed after the one and before the other has left no digest.
            if (path / DIGEST).is_file() and (path / DIGEST).read_text() != directory_digest(path / "default"):
                raise ValueError("it is damaged")
            with _no_tracebacks():
                state = self._manager.restore(epoch, args=ocp.args.StandardRestore(target))
            for found, expected in zip(jax.tree.leaves(state), jax.tree.leaves(target), strict=True):
                if (found.shape, found.dtype) != (expected.shape, expected.dtype):
                    raise ValueError(f"it has {found.dtype} {found.shape} for {expected.dtype} {expected.shape}")
        except Exception as error:  # orbax raises whatever its storage layers raise
            raise InputError(
                f"checkpoint: {path} cannot be read: {_first_line(error)}; without {self.folder}, training begins anew"
            ) from None
        return state


def _score(metrics: dict[str, float]) -> float:
    return metrics["score"]


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:300]


def _cause(error: Exception) -> tuple[int | None, str]:
    """Number and words of what the system said: an OSError's, or those in the text of tensorstore's error."""
    found = re.search(r"os_error_code='(\d+)'", str(error))
    number = error.errno if isinstance(error, OSError) else int(found[1]) if found else None
    return number, os.strerror(number) if number else _first_line(error)


@contextlib.contextmanager
def _no_tracebacks() -> Iterator[None]:
    """What orbax raises it also logs, thread by thread."""
    logger = logging.getLogger("absl")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before
