"""Checkpoints and run directories: which epochs are kept, what they restore, and what remains after a failure."""

import errno
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_refused, full_disk

from training.fitting.loop import Checkpoints, _quiet_orbax, find_run_directories


class State(NamedTuple):
    weights: Any
    count: Any
    key: Any


def state(seed: int, size: int = 100) -> State:
    rng = np.random.default_rng(seed)
    weights = {"a": jnp.asarray(rng.random((size, 7))), "none": jnp.zeros((3, 0))}
    return State(weights, jnp.int32(seed), jnp.asarray([seed], jnp.uint32))


def assert_equal(a: State, b: State) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def epochs(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_the_last_and_the_latest_of_the_best_are_kept(tmp_path: Path) -> None:
    with Checkpoints(tmp_path / "c") as checkpoints:
        assert checkpoints.last_epoch == checkpoints.best_epoch == 0
        for epoch, score in enumerate((-3.0, 0.9, 0.9, -0.3), 1):
            checkpoints.save(epoch, state(epoch), score)
    assert epochs(tmp_path / "c") == {"3", "4"}
    with Checkpoints(tmp_path / "c") as checkpoints:
        assert (checkpoints.last_epoch, checkpoints.best_epoch) == (4, 3)
        assert_equal(checkpoints.last(state(0)), state(4))
        assert_equal(checkpoints.best(state(0)), state(3))
        assert_refused("checkpoint: ", checkpoints.last, state(0, 99))  # has another shape
        checkpoints.save(5, state(5), 0.95)
        assert (checkpoints.last_epoch, checkpoints.best_epoch) == (5, 5)
    assert epochs(tmp_path / "c") == {"5"}


def test_incomplete_checkpoints_are_removed(tmp_path: Path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
    (tmp_path / "2.orbax-checkpoint-tmp").mkdir()
    (tmp_path / "2.orbax-checkpoint-tmp" / "default").write_bytes(b"half")
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.last_epoch == 1
        checkpoints.save(2, state(2), 1.0)
    assert epochs(tmp_path) == {"2"}


def full_file_system(*_: Any, **__: Any) -> None:
    raise ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device [os_error_code='28']\n[more='x']")


@pytest.mark.parametrize("fail", [full_disk, full_file_system])
def test_the_last_checkpoint_survives_a_full_disk(fail: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
        with monkeypatch.context() as patch:
            patch.setattr(checkpoints._manager, "save", fail)
            with pytest.raises(OSError, match="epoch 2 .*No space left") as caught:
                checkpoints.save(2, state(2), 1.0)
            assert caught.value.errno == errno.ENOSPC and caught.value.filename == str(tmp_path)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.last_epoch == 1
        assert_equal(checkpoints.last(state(0)), state(1))


def test_a_damaged_checkpoint_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
    for file in sorted(path for path in (tmp_path / "1" / "default").rglob("*") if path.is_file()):
        content = file.read_bytes()
        middle = len(content) // 2
        for damaged in (content[:middle], content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :]):
            file.write_bytes(damaged)
            with Checkpoints(tmp_path) as checkpoints:
                assert_refused(f"checkpoint: {tmp_path / '1'} ", checkpoints.last, state(0))
        file.write_bytes(content)
    with Checkpoints(tmp_path) as checkpoints:
        assert_equal(checkpoints.last(state(0)), state(1))
    assert "Traceback" not in capfd.readouterr().err


def test_threads_of_a_failed_save_print_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    """They find their event loop closed, while the error is raised and after it; other errors are printed."""
    printed = []
    monkeypatch.setattr(sys, "excepthook", lambda kind, error, traceback: printed.append(str(error)))
    hook = sys.excepthook
    with _quiet_orbax():
        pass
    assert sys.excepthook is hook
    with pytest.raises(OSError), _quiet_orbax():
        sys.excepthook(RuntimeError, RuntimeError("Event loop is closed"), None)
        raise OSError("disk full")
    sys.excepthook(RuntimeError, RuntimeError("Event loop is closed"), None)
    sys.excepthook(RuntimeError, RuntimeError("another"), None)
    assert printed == ["another"]


def test_run_directories_are_those_of_finished_folds_in_order(tmp_path: Path) -> None:
    expected = [tmp_path / name for name in ("single", "five/fold-0", "five/fold-2", "five/fold-10")]
    for path in expected:
        path.mkdir(parents=True)
        (path / "run.json").touch()
    assert find_run_directories([tmp_path / "single", tmp_path / "five"]) == expected
    (tmp_path / "five" / "checkpoints").mkdir()
    (tmp_path / "five" / "checkpoints" / "begun.json").touch()
    assert_refused("model: ", find_run_directories, [tmp_path / "five"])
    assert find_run_directories(expected[1:2]) == expected[1:2]
