"""Samples of distractors in the user's cache: kept, renewed, bounded, and unusable caches."""

import logging
import os
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from failures import small_disk
from rendered_objects import write_box
from small_runs import SMALL_CONFIG

import colornet
import thor2_jax as thor2
import training
from training.embedding import distractors as module
from training.embedding.distractors import Distractors, distractor_samples, samples_record
from training.fitting.samples import Samples
from training.storage.jobs import locked

NETWORK = colornet.load_default()

SAMPLES = Samples(
    lengths=np.array([2, 1]),
    strip=np.array([1, 4, 2], np.uint32),
    length=np.array([0.1, 0.2, 0.3], np.float16),
    colors=np.array([1, 3]),
    cell=np.array([1, 2, 4, 5], np.uint32),
    color=np.arange(4, dtype=np.float16),
    statistics=np.ones((2, 14), np.float32),
    label=np.array([0, 1], np.int32),
    view=np.zeros(2, np.int32),
)


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
        with mock.patch.object(module, "sample_objects", return_value=SAMPLES) as build:
            samples = distractor_samples(distractors, tmp_path / "new", NETWORK, SMALL_CONFIG, lambda *values: None)
        np.testing.assert_equal(vars(samples), vars(SAMPLES))
        assert (samples.length.dtype, samples.strip.dtype) == (np.float16, np.uint32)
        return build.call_count

    return get


def files(cache: Path) -> list[Path]:
    return sorted(cache.glob("*.safetensors"))


def test_samples_are_built_once(
    cache: Path, counted: Callable[..., int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Each job and each version of the code has its own samples."""
    with locked(cache):
        assert counted() == 1  # does not wait for another process
    assert [counted(), counted(), counted(1), counted(), counted(1)] == [1, 0, 1, 0, 0]
    assert len(files(cache)) == 2
    with monkeypatch.context() as patch:
        patch.setattr(thor2, "__version__", "99")
        assert [counted(), counted()] == [1, 0]
    (code := cache.parent / "code" / "objects").mkdir(parents=True)
    (code / "procedural.py").write_text("changed = True")
    monkeypatch.setattr(training, "__file__", str(code.parent / "__init__.py"))
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "elsewhere"))
    assert [counted(), counted()] == [1, 0] and files(tmp_path / "elsewhere") and len(files(cache)) == 3
    monkeypatch.delenv("THOR2_CACHE")
    assert [counted(), counted()] == [1, 0]


def test_three_files_are_kept_and_those_of_the_user(cache: Path, counted: Callable[..., int]) -> None:
    cache.mkdir(parents=True)
    headers = (b"a user's", b"[" * 10**5, b"[]", b'{"__metadata__": 1}', b'{"__metadata__": {"format": 1}}')
    contents = [len(header).to_bytes(8, "little") + header for header in headers]
    users = {cache / f"distractors-{k:064}.safetensors": content for k, content in enumerate(contents)}
    users |= {cache / name: b"a user's" for name in ("mine.safetensors", "notes.txt")}
    for path, content in users.items():
        path.write_bytes(content)
    for number in range(3):
        assert counted(number) == 1
    for path in files(cache):
        os.utime(path, (1, 1))
    assert counted(0) == 0  # the file used last
    assert counted(3) == 1
    own = [path for path in files(cache) if path not in users]
    assert len(own) == 3 and all(path.read_bytes() == users[path] for path in users)
    assert counted(0) == 0


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-5],
        lambda content: content[:-1] + bytes([content[-1] ^ 1]),
        lambda content: content.replace(b'"lengths"', b'"length_"'),
        lambda content: b"a user's",
    ],
)
def test_a_damaged_file_costs_one_warning(
    damage: Callable[[bytes], bytes], cache: Path, counted: Callable[..., int], caplog: pytest.LogCaptureFixture
) -> None:
    counted()
    (file,) = files(cache)
    file.write_bytes(damage(file.read_bytes()))
    assert counted() == 1
    (record,) = caplog.records
    assert record.levelno == logging.WARNING and str(file) in record.getMessage() and "\n" not in record.getMessage()
    if "delete" in record.getMessage():
        assert file.read_bytes() == b"a user's"
    else:
        assert counted() == 0


def test_a_full_or_unwritable_disk_costs_one_warning(
    cache: Path, counted: Callable[..., int], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with small_disk(200):
        assert counted() == 1
    assert files(cache) == [] and "too large" in caplog.records[-1].getMessage()
    monkeypatch.setenv("THOR2_CACHE", "/proc/no-such-directory")
    assert counted() == 1 and len(caplog.records) == 2


def test_what_determines_the_samples(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The meshes by their content, the network, the views and the descriptor; not epochs, networks or workers."""
    stored = mock.Mock(return_value=SAMPLES)
    monkeypatch.setattr(module, "_read_stored", stored)

    def key(config: thor2.DescriptorConfig = SMALL_CONFIG, box: float | None = None, **options: int) -> str:
        meshes = {} if box is None else {"box": write_box(tmp_path / "box.ply", (box, 0.1, 0.1))}
        distractors = Distractors(**{"procedural": 10, **options}, meshes=meshes)
        distractor_samples(distractors, tmp_path / "new", NETWORK, config, lambda *values: None)
        return str(stored.call_args.args[0])

    same, box = key(), key(box=0.1)
    assert key(epochs=3, networks=2, workers=2) == same and key(box=0.1) == box
    others = [key(box=0.2), key(procedural=11), key(views=3), key(thor2.DescriptorConfig(homology="closed_form"))]
    assert same not in [box, *others] and box not in others
    record = samples_record([0], NETWORK, SMALL_CONFIG, 1)
    assert record["color_network"] == NETWORK.fingerprint and "augmentations" in record
