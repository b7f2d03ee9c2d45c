"""Job records."""

import json
from pathlib import Path
from typing import Any

import pytest

from thor2_jax.errors import InputError
from training.storage.jobs import begin_job, check_same_job

JOB: dict[str, Any] = {"seed": 0, "steps": [5.0, 15.0], "camera": {"width": 800}, "variations": None}


@pytest.mark.parametrize(
    ("changes", "difference"),
    [
        ({"seed": 1}, "seed 0, not 1"),
        ({"steps": [5, 20]}, r"steps\[1\] 15.0, not 20"),
        ({"steps": [5]}, r"steps\[1\] 15.0, not null"),
        ({"camera": {"width": 640}}, "camera.width 800, not 640"),
        ({"variations": {"seed": 0}}, r'variations null, not \{"seed": 0\}'),
        ({"folds": 5}, "folds null, not 5"),
        ({"seed": "x" * 1000}, r'seed 0, not "x{99}\.\.\.;'),
    ],
)
def test_the_first_difference_is_named(changes: dict[str, Any], difference: str) -> None:
    with pytest.raises(InputError, match=f"out: run was written with {difference}"):
        check_same_job(Path("run"), JOB, JOB | changes)


def test_a_directory_begins_with_one_job(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    begin_job(out, JOB)
    begin_job(out, JOB | {"steps": (5, 15)})
    assert json.loads((out / "job.json").read_bytes()) == JOB
    with pytest.raises(InputError, match="seed 0, not 1"):
        begin_job(out, JOB | {"seed": 1})
    with pytest.raises(InputError, match="camera .*, not null"):
        begin_job(out, {name: value for name, value in JOB.items() if name != "camera"})
    assert json.loads((out / "job.json").read_bytes()) == JOB
