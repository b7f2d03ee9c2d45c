"""Compiled programs in the user's cache directory."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import assert_refused, untrained_run, write_frame

from thor2_jax.model.run_directory import save_run
from training.cli.app import enable_compilation_cache

ROOT = Path(__file__).parents[3]


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An environment without a cache, and a user's cache directory."""
    for name in list(os.environ):
        if name.startswith(("JAX_", "THOR2_")):
            monkeypatch.delenv(name)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    return tmp_path / "home" / "thor2-jax" / "xla"


def test_the_cache_can_be_moved_or_disabled(environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("THOR2_CACHE", "off")
    enable_compilation_cache()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "" and not environment.exists()
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "elsewhere"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", "")
        enable_compilation_cache()
        assert Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).parent == tmp_path / "elsewhere"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/mine")  # one of the environment is left alone
    enable_compilation_cache()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "/mine" and not environment.exists()


def test_an_unusable_cache_directory(environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A directory that cannot be created is ignored, and a file is refused."""
    monkeypatch.setenv("THOR2_CACHE", "/proc/no-such-directory")
    enable_compilation_cache()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == ""
    (tmp_path / "file").touch()
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "file"))
    assert_refused("THOR2_CACHE", enable_compilation_cache)


@pytest.mark.slow
def test_a_second_recognition_compiles_nothing(environment: Path, tmp_path: Path) -> None:
    frame = write_frame(tmp_path / "frame", {1: "brick"})
    save_run(untrained_run(("brick", "stick"), ("tops", "tops2")), tmp_path / "run")
    variables = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-m", "training.cli", "recognize", "--model", str(tmp_path / "run"), str(frame)]

    def recognize() -> tuple[set[str], str]:
        """Return the names of the cached programs, and what was printed."""
        done = subprocess.run(command, capture_output=True, text=True, env=variables)
        assert done.returncode == 0 and done.stderr == ""
        return {path.name for path in environment.glob("*/*-cache")}, done.stdout

    first = recognize()
    assert len(first[0]) > 5 and recognize() == first
