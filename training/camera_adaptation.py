"""Adaptation of a run directory to a camera: a copy whose record contains the camera's colour transform."""

import dataclasses
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from thor2_jax import Recognizer, RGBDFrame
from thor2_jax.adaptation.estimate import Adaptation, Report
from thor2_jax.errors import with_context
from thor2_jax.files import atomic_directory, check_output_directory, read_file
from thor2_jax.model.run_record import RUN_FILE
from training.readers.frames import FrameSource

__all__ = ["adapt_run"]


def adapt_run(model: Path, sources: Sequence[FrameSource], out: Path, report: Report) -> Adaptation:
    """Estimate a camera's colour transform and write a run directory that corrects colours with it.

    Args:
        model: run directory; its colour transform, if it has one, is replaced in the copy.
        sources: frames of the camera, with instance labels.
        out: new run directory.
        report: see `Recognizer.adapt`.

    Raises:
        InputError: the run or a frame cannot be read, or `out` is not empty; also as `Recognizer.adapt`. Nothing is
            written.
        OSError: a file cannot be read or written. Nothing is written.
    """
    check_output_directory(out)
    recognizer = Recognizer.load(model)

    def frames() -> Iterator[RGBDFrame]:
        for source in sources:
            with with_context(source.name):
                frame = source.read()
                frame.label_image  # noqa: B018  raises here, so that the error message names a frame without labels
            yield frame

    adaptation = recognizer.adapt(frames(), report)
    with atomic_directory(out) as run:
        _copy_files(model, run)
        description = json.loads((run / RUN_FILE).read_bytes())
        description["record"] |= {
            "color_transform": dataclasses.asdict(adaptation.transform),
            "adapted_to": {"instances": adaptation.instances},
        }
        (run / RUN_FILE).write_text(json.dumps(description, indent=2) + "\n")
    return adaptation


def _copy_files(model: Path, run: Path) -> None:
    """Copy a run directory's content, without modes and hidden files; raise OSError for devices and unreadable ones."""

    def fail(error: OSError) -> None:  # os.walk would leave out a folder that cannot be read
        raise error

    for folder, folders, names in os.walk(model, onerror=fail, followlinks=True):
        # An unfinished training left the first two.
        folders[:] = [name for name in folders if name not in ("checkpoints", "views") and not name.startswith(".")]
        target = run / Path(folder).relative_to(model)
        target.mkdir(exist_ok=True)
        for name in names:
            if not name.startswith("."):
                (target / name).write_bytes(read_file(Path(folder, name)))
