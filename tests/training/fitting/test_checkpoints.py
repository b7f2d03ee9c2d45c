"""Checkpoints: what is kept, what is given back, and what is left when something goes wrong."""

import errno
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thor2_jax as thor2
from training.fitting.checkpoints import Checkpoints


class State(NamedTuple):
    weights: Any
    count: Any
    key: Any


def state(seed: int, size: int = 100) -> State:
    rng = np.random.default_rng(seed)
    return State({"a": jnp.asarray(rng.random((size, 7)))}, jnp.int32(seed), jnp.asarray([seed], jnp.uint32))


def same(a: State, b: State) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


def epochs(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_the_last_and_the_best_are_kept(tmp_path: Path) -> None:
    with Checkpoints(tmp_path / "c") as checkpoints:
        assert checkpoints.last_epoch == checkpoints.best_epoch == 0
        for epoch, score in enumerate((0.1, 0.9, 0.5, 0.3), 1):
            checkpoints.save(epoch, state(epoch), score)
    assert epochs(tmp_path / "c") == {"2", "4"}
    with Checkpoints(tmp_path / "c") as checkpoints:
        assert (checkpoints.last_epoch, checkpoints.best_epoch) == (4, 2)
        same(checkpoints.last(state(0)), state(4))
        same(checkpoints.best(state(0)), state(2))
        checkpoints.save(5, state(5), 0.95)
        assert (checkpoints.last_epoch, checkpoints.best_epoch) == (5, 5)
    assert epochs(tmp_path / "c") == {"5"}


def test_scores_may_be_negative_and_the_later_of_equals_is_the_best(tmp_path: Path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        for epoch, score in enumerate((-3.0, -2.0, -2.0, -2.5), 1):
            checkpoints.save(epoch, state(epoch), score)
        assert (checkpoints.last_epoch, checkpoints.best_epoch) == (4, 3)


def test_leftovers_of_a_crash_are_cleared_away(tmp_path: Path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
    (tmp_path / "2.orbax-checkpoint-tmp").mkdir()
    (tmp_path / "2.orbax-checkpoint-tmp" / "default").write_bytes(b"half")
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.last_epoch == 1
        checkpoints.save(2, state(2), 1.0)
    assert epochs(tmp_path) == {"2"}


def full_disk(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def full_file_system(*_: Any, **__: Any) -> None:
    raise ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device [os_error_code='28']\n[more='x']")


@pytest.mark.parametrize("fail", [full_disk, full_file_system])
def test_a_full_disk_is_told_of_and_the_last_good_one_stays(
    fail: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
        with monkeypatch.context() as patch:
            patch.setattr(checkpoints._manager, "save", fail)
            with pytest.raises(OSError, match="checkpoint of epoch 2 cannot be written: No space left") as caught:
                checkpoints.save(2, state(2), 1.0)
            assert caught.value.errno == errno.ENOSPC and caught.value.filename == str(tmp_path)
    with Checkpoints(tmp_path) as checkpoints:
        assert checkpoints.last_epoch == 1
        same(checkpoints.last(state(0)), state(1))


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError):
        Checkpoints(tmp_path / "file" / "c")


def test_a_damaged_checkpoint_is_named_and_no_numbers_are_made_of_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
    for file in sorted(path for path in (tmp_path / "1" / "default").rglob("*") if path.is_file()):
        content = file.read_bytes()
        middle = len(content) // 2
        for damaged in (content[:middle], content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :]):
            file.write_bytes(damaged)
            with Checkpoints(tmp_path) as checkpoints:
                with pytest.raises(thor2.InputError, match=f"checkpoint: {tmp_path / '1'} cannot be read") as caught:
                    checkpoints.last(state(0))
                assert "\n" not in str(caught.value)
        file.write_bytes(content)
    with Checkpoints(tmp_path) as checkpoints:
        same(checkpoints.last(state(0)), state(1))
    assert "Traceback" not in capfd.readouterr().err


def test_another_structure_is_refused(tmp_path: Path) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(1, state(1), 0.0)
        with pytest.raises(thor2.InputError, match="cannot be read"):
            checkpoints.last(state(0, 99))
