"""Evaluation of trained runs on a dataset: answers frame by frame, then `report.json` and `report.html`.

Each frame is recognized with the classifiers and baselines of all runs, in this process or in workers.

REPORT/answers.jsonl               class probabilities of every classifier, written frame by frame
REPORT/report.json, report.html    written last
"""

import contextlib
import dataclasses
import functools
import json
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thor2_jax import DESCRIPTOR_VERSION, InputError, RGBDFrame
from thor2_jax.files import check_output_directory, file_digest, locked, write_text
from thor2_jax.model.recognition import overflow_reason
from thor2_jax.printable import find_name
from training.baselines.baseline import BaselineInputs
from training.evaluation.answers import AnswerFile, FrameAnswers, InstancePrediction
from training.evaluation.frame_pictures import draw_pictures
from training.evaluation.page import write_report_page
from training.evaluation.results import check_known, compute_results
from training.evaluation.runs import Run, all_predictors, load_runs
from training.readers.labelled import LabelledFrame, LabelledFrames
from training.storage.jobs import Progress
from training.storage.workers import WorkerPool

__all__ = ["answer_frames", "answer_frames_in_pool", "evaluate_dataset", "load_runs"]

Answering = Callable[[range], Generator[FrameAnswers, None, None]]
"""Function that yields the answers for the frames with these numbers, such as `answer_frames_in_pool`."""

ANSWERS = "answers.jsonl"

NO_PIXELS = "no pixels in the label image"
"""Reason of a labelled instance that has no pixels and therefore cannot be described."""

Load = tuple[tuple[Path, ...], tuple[str, ...] | None]
"""Arguments of `load_runs`."""


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
        runs: runs, as returned by `load_runs`.
        frames: the dataset.
        dataset: "kind" (uwis, ocid, bop, frames), "path", and all other values on which the frames depend.
        out: directory of the report: new, empty, or of the same evaluation.
        progress: called with ("evaluate", frames done, number of frames, note).
        answering: function that answers frames with the same runs, for instance in worker processes; None uses this
            process.

    Returns:
        The content of report.json.

    Raises:
        InputError: `out` holds something else, or answers of another evaluation or for files that have changed; another
            process is writing to it; a frame cannot be read; or no instance is of a class of the runs. Answers so far
            are kept.
        OSError: a file cannot be written.
    """
    check_output_directory(out, ANSWERS)
    if (names := frames.names()) is not None:
        check_known(names, runs[0].classes)  # not only after all frames are recognized
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
        first, start = len(file.frames), time.perf_counter()
        progress("evaluate", first, len(frames), "")
        with contextlib.closing(answering(range(first, len(frames)))) as answered:
            for number, answers in enumerate(answered, first):
                file.append(dataclasses.replace(answers, files=_file_digests(frames.files(number))))
                rate = (number + 1 - first) / (time.perf_counter() - start)
                progress("evaluate", number + 1, len(frames), f"{rate:.2f} frames/s, {answers.frame}")
        report = {"dataset": description, "digests": digests, **compute_results(dataset["kind"], runs, file.frames)}
        report["no_pixels"] = [
            {"frame": answers.frame, "label": instance.label, "truth": instance.truth}
            for answers in file.frames
            for instance in answers.instances
            if instance.reason == NO_PIXELS
        ]
        confusions = [(pair["truth"], pair["answer"]) for pair in report["worst"]]
        report["shown"], drawn = draw_pictures(frames, file.frames, runs, confusions, out)
        report["worst"] = [pair | where for pair, where in zip(report["worst"], drawn, strict=True)]
        write_report_page(report, out)
        write_text(out / "report.json", json.dumps(report, indent=1) + "\n")
        return report


def _file_digests(files: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 of each file, without missing files."""
    return {str(path.resolve()): file_digest(path) for path in files if path.is_file()}


def _check_unchanged(file: AnswerFile, frames: LabelledFrames, out: Path, progress: Progress) -> None:
    """Raise InputError if the names or files of frames with stored answers have changed."""
    for number, (answers, identifier) in enumerate(zip(file.frames, frames.identifiers, strict=False)):
        if answers.frame != identifier:
            raise InputError(
                f"out: frame {number} in {out / ANSWERS} is {answers.frame!r}, but the dataset has {identifier!r}; "
                "choose another directory"
            )
        if answers.files:
            if changed := answers.files.items() ^ _file_digests(frames.files(number)).items():
                raise InputError(f"out: {out} was written before {min(changed)[0]} changed; choose another directory")
        progress("check files", number + 1, len(file.frames), "")


def answer_frames(runs: Sequence[Run], frames: Iterable[LabelledFrame]) -> Generator[FrameAnswers, None, None]:
    """Yield the answers for every frame; a frame is described once for all runs.

    Args:
        runs: runs that share classes, descriptor and colour network, see `load_runs`.
        frames: frames in memory, or an iterable that reads them.

    Raises:
        InputError: a frame cannot be read.
    """
    start = time.perf_counter()
    for item in frames:
        instances = _answer(runs, item)
        yield FrameAnswers(item.identifier, item.attributes, time.perf_counter() - start, instances)
        start = time.perf_counter()


def answer_frames_in_pool(
    load: Load, frames: LabelledFrames, pool: WorkerPool, numbers: range
) -> Generator[FrameAnswers, None, None]:
    """Yield the answers of `answer_frames` for the frames with these numbers, computed by workers.

    If a frame cannot be read, the answers for the frames before it are yielded before its error is raised.

    Args:
        load: arguments of `load_runs`, with which each worker process loads the runs.
        frames: the dataset.
        pool: the workers.
        numbers: numbers of the frames.

    Raises:
        InputError: as `answer_frames`.
        OSError: a file cannot be opened, or workers die repeatedly.
    """
    return pool(functools.partial(_answer_first, load), map(frames.only, numbers))


_loaded = functools.lru_cache(1)(load_runs)
"""Cached `load_runs`, which loads the runs only once in each worker process."""


def _answer_first(load: Load, frames: LabelledFrames) -> FrameAnswers:
    return next(answer_frames(_loaded(*load), frames))


def _answer(runs: Sequence[Run], item: LabelledFrame) -> list[InstancePrediction]:
    recognizer = runs[0].recognizer
    described = recognizer.describe(item.frame)
    rows = {instance.label: (row, instance.occluded) for row, instance in enumerate(described.usable)}
    has_baselines = rows and any(run.baselines for run in runs)
    inputs = BaselineInputs.of_frame(described, recognizer.run.config, item.frame) if has_baselines else None
    values = [run.probabilities(item.identifier, described, inputs) for run in runs] if rows else []
    overflow = iter(described.oriented.overflow.tolist())  # of the usable instances
    reasons = {i.label: i.reason or overflow_reason(next(overflow), len(i.points)) for i in described.instances}
    answers = []
    for label, name in sorted(item.truth.items()):
        truth, position = find_name(name, runs[0].classes) or name, _position(item.frame, label)
        if (reason := reasons.get(label, NO_PIXELS)) is not None:
            answers.append(InstancePrediction(label, truth, reason=reason, position=position))
        else:
            row, occluded = rows[label]
            probabilities = np.stack([values[index][name][row] for index, name in all_predictors(runs)])  # [M, C]
            answers.append(InstancePrediction(label, truth, occluded, None, probabilities, position))
    return answers


def _position(frame: RGBDFrame, label: int) -> list[float] | None:
    """Return the median x, y and z of an instance's points, rounded to 0.1 mm; None if no pixel has depth."""
    points = frame.points(frame.instance_pixels.get(label, np.zeros(0, np.intp)))
    points = points[points[:, 2] > 0]
    return list(np.median(points, axis=0).round(4).tolist()) if len(points) else None
