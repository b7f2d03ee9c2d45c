"""Checkpoints and run directories: which epochs are kept, what they restore, and what remains after a failure."""

import errno
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from failures import small_disk
from refusals import assert_refused
from written_files import files_of

from colornet import files
from training.fitting.loop import Checkpoints
from training.storage.jobs import load_arrays, save_arrays
from training.train_run import find_run_directories


def state(seed: int, size: int = 100) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    weights = {"a": jnp.asarray(rng.random((size, 7))), "none": jnp.zeros((3, 0))}
    return {"weights": weights, "count": jnp.int32(seed), "key": jnp.asarray([seed], jnp.uint32)}


assert_equal = functools.partial(jax.tree.map, functools.partial(np.testing.assert_array_equal, strict=True))


def test_the_last_and_the_latest_of_the_best_are_kept(tmp_path: Path) -> None:
    """Leftovers of a killed process are removed, and other files stay."""
    checkpoints = Checkpoints(tmp_path / "c")
    assert checkpoints.last_epoch == checkpoints.best_epoch == 0
    assert_equal(checkpoints.last(state(0)), state(0))
    for epoch, score in enumerate((-3.0, 0.9, 0.9, -0.3), 1):
        checkpoints.save(epoch, state(epoch), score)
    assert files_of(tmp_path / "c").keys() == {"3.safetensors", "4.safetensors"}
    (tmp_path / "c" / "notes.txt").touch()
    (tmp_path / "c" / ".thor2-x").mkdir()
    (tmp_path / "c" / ".thor2-x" / ".thor2").write_bytes(files._MARKER_TEXT)
    checkpoints = Checkpoints(tmp_path / "c")
    assert (checkpoints.last_epoch, checkpoints.best_epoch) == (4, 3)
    assert_equal(checkpoints.last(state(0)), state(4))
    assert_equal(checkpoints.best(state(0)), state(3))
    assert_refused("checkpoint: ", checkpoints.last, state(0, 99))  # has another shape
    checkpoints.save(5, state(5), 0.95)
    assert (checkpoints.last_epoch, checkpoints.best_epoch) == (5, 5)
    assert files_of(tmp_path / "c").keys() == {"5.safetensors", "notes.txt"}


def test_arrays_of_any_order_are_restored(tmp_path: Path) -> None:
    values = np.arange(12, dtype=np.float32).reshape(3, 4)
    arrays = {"fortran": np.asfortranarray(values), "strided": values[:, ::2], "single": np.array(3.0)}
    save_arrays(tmp_path / "a.safetensors", arrays, {})
    np.testing.assert_equal(load_arrays(tmp_path / "a.safetensors"), arrays)


def test_the_last_checkpoint_survives_a_full_disk(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(1), 0.0)
    with small_disk(1000), pytest.raises(OSError, match="too large") as caught:
        checkpoints.save(2, state(2), 1.0)
    assert caught.value.errno == errno.EFBIG and caught.value.filename == str(tmp_path / "2.safetensors")
    assert files_of(tmp_path).keys() == {"1.safetensors"}
    assert Checkpoints(tmp_path).last_epoch == checkpoints.last_epoch == 1
    assert_equal(checkpoints.last(state(0)), state(1))


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    """The bytes are those of the header, of an array and of the last one."""
    Checkpoints(tmp_path).save(1, state(1), 0.0)
    file = tmp_path / "1.safetensors"
    content = file.read_bytes()
    for place in (0, 9, len(content) // 2, len(content) - 1):
        for damaged in (content[:place], content[:place] + bytes([content[place] ^ 255]) + content[place + 1 :]):
            file.write_bytes(damaged)
            assert_refused(f"checkpoint: {file} cannot be read", lambda: Checkpoints(tmp_path).last(state(0)))
    for metadata in ("1", '{"score": []}', '{"score": null}'):
        header = f'{{"__metadata__": {metadata}}}'.encode()
        file.write_bytes(len(header).to_bytes(8, "little") + header)
        assert_refused(f"checkpoint: {file} cannot be read", Checkpoints, tmp_path)
    file.write_bytes(content)
    assert_equal(Checkpoints(tmp_path).last(state(0)), state(1))


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
