"""Evaluation of trained runs on a dataset: answers frame by frame, then `report.json` and `report.html`.

REPORT/answers.jsonl               class probabilities of every classifier, written frame by frame
REPORT/report.json, report.html    written last
"""

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.errors import InputError
from thor2_jax.files import check_output_directory, file_digest, remove_leftovers, write_text
from training.evaluation.answering import NO_PIXELS, answer_frames
from training.evaluation.answers import AnswerFile, FrameAnswers
from training.evaluation.frame_pictures import FramePictures
from training.evaluation.page import write_report_page
from training.evaluation.results import compute_results
from training.evaluation.runs import Run, all_predictors
from training.readers.labelled import LabelledFrame, LabelledFrames
from training.storage.jobs import Progress, locked

__all__ = ["Answering", "evaluate_dataset"]

Answering = Callable[[range], Generator[tuple[LabelledFrame, FrameAnswers], None, None]]
"""Yields the frames of these numbers with their answers, such as `answering.answer_frames_in_pool`."""

ANSWERS = "answers.jsonl"


def evaluate_dataset(
    runs: Sequence[Run],
    frames: LabelledFrames,
    dataset: Mapping[str, str],
    out: Path,
    progress: Progress = lambda stage, done, total, note: None,
    answering: Answering | None = None,
) -> dict[str, Any]:
    """Evaluate runs on a dataset and write the report. An interrupted evaluation resumes.

    A frame is described once for all runs, and its answers are saved before the next frame is read.

    Args:
        runs: runs, as returned by `load_runs` or `load_sequence_runs`.
        frames: the dataset.
        dataset: "kind" (uwis, ocid, bop, frames), "path", and all other values that the frames depend on.
        out: directory of the report: new, empty, or of the same evaluation.
        progress: called with ("evaluate", frames done, number of frames, note).
        answering: answers frames with the same runs, for instance in worker processes; None answers them in this
            process.

    Returns:
        The content of report.json.

    Raises:
        InputError: `out` holds something else, or the answers of another evaluation or of files that have changed;
            another process is writing to it; a frame cannot be read; or no instance is of a class of the runs. Answers
            so far are kept.
        OSError: a file cannot be written.
    """
    check_output_directory(out, ANSWERS)
    if not out.exists():
        frames[0]  # raises if it cannot be read, before anything is written
    answering = answering or (lambda numbers: answer_frames(runs, (frames[number] for number in numbers)))
    with locked(out):
        description = {**dataset, "frames": len(frames)}
        digests = [run.digest for run in runs]
        header = {
            "dataset": description,
            "descriptor_version": DESCRIPTOR_VERSION,
            "runs": digests,
            "classifiers": [list(predictor) for predictor in all_predictors(runs)],
        }
        file = AnswerFile(out / ANSWERS, header)
        _check_unchanged(file, frames, out, progress)
        for directory in (out, out / "frames", out / "confusions"):
            remove_leftovers(directory)
        pictures = FramePictures(out, runs, len(frames))
        for answers in file.frames:
            pictures.restore(answers)
        first, start = len(file.frames), time.perf_counter()
        progress("evaluate", first, len(frames), "")
        with contextlib.closing(answering(range(first, len(frames)))) as answered:
            for number, (item, answers) in enumerate(answered, first):
                pictures.draw(number, item, answers)  # before the frame counts as done
                file.append(dataclasses.replace(answers, files=_file_digests(frames.files(number))))
                rate = (number + 1 - first) / (time.perf_counter() - start)
                progress("evaluate", number + 1, len(frames), f"{rate:.2f} frames/s, {item.identifier}")
        report = {"dataset": description, "digests": digests, **compute_results(dataset["kind"], runs, file.frames)}
        report["no_pixels"] = [
            {"frame": answers.frame, "label": instance.label, "truth": instance.truth}
            for answers in file.frames
            for instance in answers.instances
            if instance.reason == NO_PIXELS
        ]
        report["shown"] = [file.frames[number].frame for number in pictures.shown]
        write_report_page(report, pictures, out)
        write_text(out / "report.json", json.dumps(report, indent=1) + "\n")
        return report


def _file_digests(files: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 of each file; a missing one has none."""
    return {str(path.resolve()): file_digest(path) for path in files if path.is_file()}


def _check_unchanged(file: AnswerFile, frames: LabelledFrames, out: Path, progress: Progress) -> None:
    """Raise InputError if frames that are already answered have another name or other files now."""
    for number, (answers, identifier) in enumerate(zip(file.frames, frames.identifiers, strict=False)):
        if answers.frame != identifier:
            raise InputError(
                f"out: frame {number} in {out / ANSWERS} is {answers.frame!r}, but the dataset has {identifier!r}; "
                "choose another directory"
            )
        if answers.files:
            stored, current = answers.files.items(), _file_digests(frames.files(number)).items()
            if stored != current:
                path = min(stored ^ current)[0]
                raise InputError(f"out: {out} was written before {path} changed; choose another directory")
        progress("check files", number + 1, len(file.frames), "")
