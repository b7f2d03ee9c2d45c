"""Run directories and the folds of a training."""

from pathlib import Path

import pytest

from thor2_jax.errors import InputError
from training.fitting.checkpoints import find_run_directories


def test_folds_are_listed_in_numeric_order(tmp_path: Path) -> None:
    for name in ("single", "five/fold-10", "five/fold-2", "five/fold-0"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "run.json").touch()
    directories = find_run_directories([tmp_path / "single", tmp_path / "five"])
    assert [path.relative_to(tmp_path).as_posix() for path in directories] == [
        "single",
        "five/fold-0",
        "five/fold-2",
        "five/fold-10",
    ]


def test_unfinished_training_is_refused_but_not_its_folds(tmp_path: Path) -> None:
    fold = tmp_path / "run" / "fold-0"
    fold.mkdir(parents=True)
    (fold / "run.json").touch()
    (tmp_path / "run" / "checkpoints").mkdir()
    (tmp_path / "run" / "checkpoints" / "begun.json").touch()
    with pytest.raises(InputError, match="model: "):
        find_run_directories([tmp_path / "run"])
    assert find_run_directories([fold]) == [fold]
