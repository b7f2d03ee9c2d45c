"""Samples of distractors in the user's cache: kept, renewed, bounded, and unusable caches."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from rendered_objects import write_box
from scipy.sparse import csr_array
from small_clouds import NETWORK
from small_runs import SMALL_CONFIG
from written_files import files_of_the_user

import thor2_jax as thor2
from training.embedding import distractors as module
from training.embedding.distractors import Distractors, samples_record
from training.fitting.samples import Samples

STRIPS = csr_array(np.array([[0, 0.1, 0, 0], [0.2, 0, 0, 3]], np.float32))
SAMPLES = Samples(STRIPS, np.ones((2, 14), np.float32), np.array([0, 1], np.int32), np.zeros(2, np.int32))


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache directory of a user."""
    monkeypatch.delenv("THOR2_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    return tmp_path / "home" / "thor2-jax" / "distractors"


@pytest.fixture
def counted(tmp_path: Path) -> Callable[..., int]:
    """Return a function that asks for the samples of distractors, checks them and returns how often they were built."""

    def get(number: int = 0) -> int:
        distractors = Distractors(procedural=10 + number)
        cloud = np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)
        with (
            mock.patch.object(module, "render_clouds", lambda objects, views: [(index, cloud) for index in objects]),
            mock.patch.object(module, "sample_normalized", return_value=SAMPLES) as build,
        ):
            samples = distractors.samples(tmp_path / "new", NETWORK, SMALL_CONFIG, lambda *values: None)
        np.testing.assert_equal(samples.arrays(), SAMPLES.arrays())
        return build.call_count

    return get


def stored(cache: Path) -> list[Path]:
    return sorted(path for path in cache.glob("distractors-*") if path.is_dir())


def test_samples_are_built_once(
    cache: Path, counted: Callable[..., int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each job and each version of the code has its own samples."""
    assert [counted(), counted(), counted(1), counted(), counted(1)] == [1, 0, 1, 0, 0]
    assert len(stored(cache)) == 2
    with monkeypatch.context() as patch:
        patch.setattr(thor2, "__version__", "99")
        assert [counted(), counted()] == [1, 0]
    (code := cache.parent / "code" / "objects").mkdir(parents=True)
    (code / "procedural.py").write_text("changed = True")
    monkeypatch.setattr("training.__file__", str(code.parent / "__init__.py"))
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "elsewhere"))
    assert [counted(), counted()] == [1, 0] and stored(tmp_path / "elsewhere") and len(stored(cache)) == 3
    monkeypatch.delenv("THOR2_CACHE")
    assert [counted(), counted()] == [1, 0]


def test_the_samples_used_last_are_kept_and_the_files_of_the_user(cache: Path, counted: Callable[..., int]) -> None:
    with files_of_the_user(cache / "notes.txt", cache / f"distractors-{0:064}.safetensors"):
        for number in range(3):
            assert counted(number) == 1
        for path in stored(cache):
            os.utime(path, (1, 1))
        assert [counted(0), counted(3)] == [0, 1]
    assert len(stored(cache)) == 3 and counted(0) == 0


def test_a_full_or_unwritable_disk_costs_one_warning(
    cache: Path, counted: Callable[..., int], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with mock.patch.object(module, "save_arrays", side_effect=[OSError(errno.ENOSPC, "No space left"), None]):
        assert counted() == 2
    assert "No space left" in caplog.records[-1].getMessage()
    monkeypatch.setenv("THOR2_CACHE", "/proc/no-such-directory")
    assert counted() == 1 and len(caplog.records) == 2


def test_what_determines_the_samples(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The meshes by their content, the network, the views and the descriptor; not epochs, networks or workers."""
    sample = mock.Mock(return_value=SAMPLES)
    monkeypatch.setattr(module, "sample_objects", sample)

    def key(config: thor2.DescriptorConfig = SMALL_CONFIG, box: float | None = None, **options: int) -> Any:
        meshes = {} if box is None else {"box": write_box(tmp_path / "box.ply", (box, 0.1, 0.1))}
        distractors = Distractors(**{"procedural": 10, **options}, meshes=meshes)
        distractors.samples(tmp_path / "new", NETWORK, config, lambda *values: None)
        return sample.call_args.kwargs["directory"], distractors.record["meshes"]

    same, box = key(), key(box=0.1)
    assert key(epochs=3, networks=2, workers=2) == same and key(box=0.1) == box
    others = [key(box=0.2), key(procedural=11), key(views=3), key(thor2.DescriptorConfig(homology="closed_form"))]
    assert same not in [box, *others] and box not in others
    assert [name for name, _ in box[1]] == ["box"] and box[1] != others[0][1]
    # With another order, other distractors would be held out when a training resumes.
    assert Distractors(procedural=9, meshes={"box": tmp_path}).sources == [3, 5, 1, 6, 2, 4, 8, tmp_path, 7, 0]
    record = samples_record([0], NETWORK, SMALL_CONFIG, 1)
    assert record["color_network"] == NETWORK.fingerprint and "augmentations" in record
