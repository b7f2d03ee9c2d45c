"""`thor2 serve` reports errors at startup in one line and exits with code 2."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from training.cli import main


def run_serve(*options: str) -> str:
    """Run the command, which must fail, and return its standard error."""
    command = [sys.executable, "-m", "training.cli", "serve", *options]
    ended = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2, ended.stderr
    return ended.stderr


def serve(*options: str) -> str:
    """Run the command, which must fail, and return its error line."""
    (line,) = [line for line in run_serve(*options).splitlines() if not line.startswith("INFO: ")]
    assert line.startswith("error: ")
    return line


@pytest.mark.parametrize("workers", ["1", "2"])
def test_missing_run_directory(tmp_path: Path, workers: str) -> None:
    assert "model: " in serve("--model", str(tmp_path), "--port", "0", "--workers", workers)


@pytest.mark.parametrize("workers", ["1", "2"])
def test_listening_is_logged_after_loading_the_model(tmp_path: Path, workers: str) -> None:
    assert "listening at" not in run_serve("--model", str(tmp_path), "--port", "0", "--workers", workers)


def test_cache_that_is_a_file(run_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "cache").touch()
    assert "cache" in serve("--model", str(run_dir), "--port", "0", "--cache", str(tmp_path / "cache"))


def test_xla_log_is_silenced_before_jax_is_imported() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    code = "import sys, training; print('jax' in sys.modules); import os, training.cli; print(os.environ[sys.argv[1]])"
    command = [sys.executable, "-c", code, "TF_CPP_MIN_LOG_LEVEL"]
    ended = subprocess.run(command, cwd=Path(__file__).parents[3], env=environment, capture_output=True, text=True)
    assert ended.stdout.split() == ["False", "3"], ended.stderr


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
    assert end.value.code == 2 and "'.[serve]'" in capsys.readouterr().err
