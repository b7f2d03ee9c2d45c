"""Job records, and exclusive locks on output directories."""

import json
from pathlib import Path
from typing import Any

import pytest
from refusals import assert_refused

from thor2_jax.files import LOCK, locked
from training.storage.jobs import begin_job, check_same_job

JOB: dict[str, Any] = {"seed": 0, "steps": [5.0, 15.0], "camera": {"width": 800}, "variations": None}


def test_the_first_difference_is_named() -> None:
    for requested, difference in (
        (JOB | {"seed": 1}, "seed 0, not 1"),
        (JOB | {"steps": [5, 20]}, r"steps\[1\] 15.0, not 20"),
        (JOB | {"steps": [5]}, r"steps\[1\] 15.0, not null"),
        (JOB | {"camera": {"width": 640}}, "camera.width 800, not 640"),
        (JOB | {"variations": {"seed": 0}}, r'variations null, not \{"seed": 0\}'),
        (JOB | {"folds": 5}, "folds null, not 5"),
        (JOB | {"seed": "x" * 1000}, r'seed 0, not "x{99}\.\.\.;'),
        ({name: JOB[name] for name in ("seed", "steps", "variations")}, "camera .*, not null"),
    ):
        assert_refused(f"out: run was written with {difference}", check_same_job, Path("run"), JOB, requested)


def test_a_directory_begins_with_one_job(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    begin_job(out, JOB)
    begin_job(out, JOB | {"steps": (5, 15)})
    assert_refused("seed 0, not 1", begin_job, out, JOB | {"seed": 1})
    assert json.loads((out / "job.json").read_bytes()) == JOB


def test_a_locked_directory_that_stays_empty_is_removed(tmp_path: Path) -> None:
    for name, error in (("deep", ZeroDivisionError), (300 * "a" + "/deep", OSError)):
        with pytest.raises(error), locked(tmp_path / "new" / name):
            1 / 0  # noqa: B018
    assert not list(tmp_path.iterdir())
    with locked(tmp_path / "new" / "deep"):
        (tmp_path / "new" / "deep" / "file").touch()
    assert sorted(path.name for path in (tmp_path / "new" / "deep").iterdir()) == [LOCK, "file"]
    (tmp_path / "old").mkdir()
    with locked(tmp_path / "old"):
        pass
    assert (tmp_path / "old").is_dir()
