"""All writers on a disk that becomes full at any step: no file is partial or lost."""

import builtins
import errno
import functools
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from small_clouds import NETWORK
from small_runs import untrained_run

import thor2_jax as thor2
from colornet.draw import draw_similarity
from thor2_jax.files import write_text
from thor2_jax.frames.overlay import draw_overlay
from thor2_jax.model.run_directory import load_run, save_run
from training.baselines.baseline import StoredBaseline
from training.evaluation.answers import AnswerFile, FrameAnswers
from training.evaluation.frame_pictures import draw_judged


class Disk:
    """Count the write operations under a directory, and fail from the n-th on, like a full disk.

    Opening for writing, writing, creating a directory and renaming each count once. Removing never fails.
    """

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder, self.count, self.fail_at = str(folder), 0, 0
        for module in (builtins, io):
            patch.setattr(module, "open", self._opening(module.open))
        for name in ("mkdir", "rename", "replace"):
            patch.setattr(os, name, self._failing(getattr(os, name)))
        patch.setattr(os, "open", self._failing(os.open, lambda flags, *_: flags & os.O_CREAT))

    def step(self, path: Any) -> None:
        if isinstance(path, (str, os.PathLike)) and os.fspath(path).startswith(self.folder):
            self.count += 1
            if self.fail_at and self.count >= self.fail_at:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(path))

    def _failing(self, function: Callable[..., Any], writes: Any = lambda *_: True) -> Callable[..., Any]:
        def wrapper(path: Any, *rest: Any, **more: Any) -> Any:
            if writes(*rest):
                self.step(path)
            return function(path, *rest, **more)

        return wrapper

    def _opening(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(path: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
            if not set(mode) & set("wxa+") or not isinstance(path, (str, os.PathLike)):
                return function(path, mode, *rest, **more)
            self.step(path)
            stream = function(path, mode, *rest, **more)
            stream.write = functools.partial(self._write, path, stream.write)
            return stream

        return wrapper

    def _write(self, path: Any, write: Callable[..., Any], content: Any) -> Any:
        try:
            self.step(path)
        except OSError:
            write(content[: len(content) // 2])  # the part that still fits
            raise
        return write(content)

    def fail_from(self, step: int) -> None:
        """Restart the count; fail from a step on, or never if it is 0."""
        self.count, self.fail_at = 0, step


@pytest.fixture
def disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(tmp_path, monkeypatch)


PHOTO = np.zeros((40, 50, 3), np.uint8)
FRAME = thor2.RGBDFrame(PHOTO, np.zeros((40, 50), np.uint16), PHOTO[..., 0] + 1, thor2.Intrinsics(1, 1, 0, 0))


WRITERS: dict[str, Callable[[Path], Any]] = {
    "network.npz": NETWORK.save,
    "similarity.png": lambda path: draw_similarity(NETWORK, path),
    "text.json": lambda path: write_text(path, "new" * 1000),
    "judged.jpg": lambda path: draw_judged(PHOTO, FRAME.label_image, [], path),
    "overlay.png": lambda path: draw_overlay(FRAME, [thor2.Recognition(1, "mug", 1.0)], path),
    "forest.safetensors": lambda path: StoredBaseline({"w": np.zeros(9)}, None).write(path, ("a",), 1.0),
}


@pytest.mark.parametrize("name", WRITERS)
def test_files_are_written_atomically(name: str, tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Figure, "savefig", lambda _, file, **options: Image.fromarray(PHOTO).save(file, "PNG"))
    path = tmp_path / name
    path.write_bytes(b"old")
    for step in range(1, 100):
        disk.fail_from(step)
        try:
            WRITERS[name](path)
        except OSError as error:
            assert error.errno == errno.ENOSPC and error.filename == str(path)
            assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
        else:
            break
    assert step > 2 and path.read_bytes() != b"old" and list(tmp_path.iterdir()) == [path]


def test_a_run_directory_is_written_atomically(tmp_path: Path, disk: Disk) -> None:
    run = untrained_run(("a", "b"), ("ce",))
    save_run(run, tmp_path / "whole")
    steps = disk.count
    for step in sorted({1, 2, 3, 5, 8, 13, steps // 2, steps - 2, steps - 1, steps} - {0}):
        disk.fail_from(step)
        with pytest.raises((OSError, thor2.InputError), match=f"{tmp_path / 'run'}'?( |$)"):
            save_run(run, tmp_path / "run")
        assert [path.name for path in tmp_path.iterdir()] == ["whole"]
    disk.fail_from(0)
    save_run(run, tmp_path / "run")
    assert load_run(tmp_path / "run").classes == ("a", "b")


def test_answers_resume_after_a_full_disk(tmp_path: Path, disk: Disk) -> None:
    """Opening fails first, then the line is cut off, which is discarded."""
    path, job, answers = tmp_path / "report" / "answers.jsonl", {"runs": ["digest"]}, FrameAnswers("a", {}, 0.5, [])
    AnswerFile(path, job).append(answers)
    for step in (1, 2):
        file = AnswerFile(path, job)
        disk.fail_from(step)
        with pytest.raises(OSError, match=str(path)):
            file.append(answers)
        disk.fail_from(0)
        assert len(AnswerFile(path, job).frames) == 1
    AnswerFile(path, job).append(answers)
    assert len(AnswerFile(path, job).frames) == 2
