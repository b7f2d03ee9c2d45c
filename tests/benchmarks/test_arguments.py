"""Bad arguments of the benchmarks are one line, and nothing is written."""

import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import cameras, levers, paper


@pytest.mark.parametrize(
    ("benchmark", "arguments", "message"),
    [
        (cameras, "", "give --model, --frames and --out"),
        (cameras, "--model x", "give --model, --frames and --out"),
        (cameras, "--model x --frames y --out z", "y"),
        (levers, "--meshes . --frames . --out out --levers none", "none"),
        (levers, "--meshes . --frames . --out out --seeds 0", "seeds"),
        (levers, "--meshes absent --frames . --out out", "absent"),
        (paper, "--meshes . --out out", "scenes and frames are missing"),
        (paper, "--meshes . --out out --frames absent --folds 0", "folds is 0"),
        (paper, "--meshes . --out out --frames absent", "absent"),
        (paper, "--meshes . --out out --frames . --baselines tree", "baselines is tree"),
    ],
)
def test_bad_arguments_write_nothing(
    benchmark: Any,
    arguments: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["benchmark", *arguments.split()])
    with pytest.raises(SystemExit) as caught:
        benchmark.main()
    error = capsys.readouterr().err if isinstance(caught.value.code, int) else f"error: {caught.value.code}"
    assert "error: " in error.splitlines()[-1] and message in error.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []
