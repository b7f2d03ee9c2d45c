"""Run directories on disk: a single run, or the folds of one training."""

from collections.abc import Iterable
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.model.run_record import RUN_FILE
from training.fitting.checkpoints import BEGUN, CHECKPOINTS

__all__ = ["find_run_directories"]


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
