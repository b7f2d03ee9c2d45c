"""`thor2 serve` reports errors at startup in one line and exits with code 2."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from training.cli import main


def serve(*options: str) -> str:
    command = [sys.executable, "-m", "training.cli", "serve", *options]
    ended = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2, ended.stderr
    lines = [line for line in ended.stderr.splitlines() if not line.startswith("INFO: ")]
    assert len(lines) == 1 and lines[0].startswith("error: "), ended.stderr
    return lines[0]


@pytest.mark.parametrize("workers", ["1", "2"])
def test_missing_run_directory(tmp_path: Path, workers: str) -> None:
    assert "model: " in serve("--model", str(tmp_path), "--port", "0", "--workers", workers)


def test_port_in_use(run_dir: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "in use" in serve("--model", str(run_dir), "--port", str(taken.getsockname()[1]))


def test_option_out_of_range(run_dir: Path) -> None:
    assert "max_batch is 7" in serve("--model", str(run_dir), "--max-batch", "7")
    assert "unknown_below is 2.0" in serve("--model", str(run_dir), "--unknown-below", "2")


def test_missing_package_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], run_dir: Path
) -> None:
    for name in [name for name in sys.modules if name.startswith("thor2_jax.service")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    monkeypatch.setattr(sys, "argv", ["thor2", "serve", "--model", str(run_dir)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2 and "thor2-jax[serve]" in capsys.readouterr().err
