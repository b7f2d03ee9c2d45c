"""Evaluation of trained runs on a dataset: answers frame by frame, then `report.json` and `report.html`.

Each frame is recognized with the classifiers and baselines of all runs, in this process or in workers.

REPORT/answers.jsonl               class probabilities of every classifier, written frame by frame
REPORT/frames/, confusions/        frames with judged answers, and crops of instances
REPORT/report.json, report.html    written last
"""

import contextlib
import dataclasses
import functools
import json
import math
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax import DESCRIPTOR_VERSION, InputError, RGBDFrame
from thor2_jax.files import check_output_directory, file_digest, locked, write_bytes, write_text
from thor2_jax.frames.frames import encode_image
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, Annotation, draw_instances
from thor2_jax.model.recognition import overflow_reason
from thor2_jax.printable import find_name
from training.baselines.baseline import BaselineInputs
from training.evaluation.answers import AnswerFile, FrameAnswers, InstancePrediction
from training.evaluation.page import write_report_page
from training.evaluation.results import check_known, compute_results, named_answers
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
            stored, current = answers.files.items(), _file_digests(frames.files(number)).items()
            if stored != current:
                path = min(stored ^ current)[0]
                raise InputError(f"out: {out} was written before {path} changed; choose another directory")
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


FRAMES = 12
"""Number of frames drawn, evenly spread over the dataset."""


def draw_pictures(
    frames: LabelledFrames,
    answers: Sequence[FrameAnswers],
    runs: Sequence[Run],
    confusions: Sequence[tuple[str, str]],
    out: Path,
) -> tuple[list[str], list[dict[str, Any]]]:
    """Draw some frames with the answers of the first run, and the most confident instance of each confusion.

    The pictures are `frames/<k>.jpg` and `confusions/<k>.jpg`, with k counted from 0.

    Args:
        frames: the dataset.
        answers: answers for all of its frames.
        runs: evaluated runs.
        confusions: object and wrong name of confusions that occur in the answers.
        out: directory of the report.

    Returns:
        The identifiers of the drawn frames, and "frame", the identifier, and "label" of each drawn instance.

    Raises:
        InputError: a frame cannot be read.
        OSError: a file cannot be written.
    """
    instances = [instance for each in answers for instance in each.instances]
    frame_of = {id(instance): number for number, each in enumerate(answers) for instance in each.instances}
    named = [(confidence, i, (i.truth, name)) for _, i, name, confidence in named_answers(instances, runs)]
    drawn = []
    for k, confusion in enumerate(confusions):
        _, instance, _ = max((each for each in named if each[-1] == confusion), key=lambda each: each[0])
        number = frame_of[id(instance)]
        drawn.append({"frame": frames.identifiers[number], "label": instance.label})
        frame = frames[number].frame
        draw_crop(frame.color, frame.label_image == instance.label, out / "confusions" / f"{k}.jpg")
    numbers = sorted({int(n) for n in np.linspace(0, len(frames) - 1, FRAMES)})
    for k, number in enumerate(numbers):
        frame = frames[number].frame
        draw_judged(frame.color, frame.label_image, _judge(answers[number], runs), out / "frames" / f"{k}.jpg")
    return [frames.identifiers[number] for number in numbers], drawn


def _judge(answers: FrameAnswers, runs: Sequence[Run]) -> list[Annotation]:
    """Return the answers of the first run, incorrect ones first; unknown objects should be rejected."""
    names = {i.label: name for run, i, name, _ in named_answers(answers.instances, runs) if run == 0}
    judged = []
    for instance in answers.instances:
        name, is_known = names.get(instance.label), instance.truth in runs[0].classes
        color = CORRECT if name == (instance.truth if is_known else None) else INCORRECT
        text = name or ("unknown" if instance.label in names else "none")
        text = text if name == instance.truth else f"{text} ({instance.truth})"
        judged.append(Annotation(instance.label, color, text))
    return sorted(judged, key=lambda each: each.paint == CORRECT)


CORRECT, INCORRECT = COLORS[2], UNRECOGNIZED
"""Bluish green and vermilion from the palette of Okabe and Ito, which people with colour blindness can distinguish."""

_LARGEST_WIDTH = 960
"""Largest width of a picture, pixels; wider frames are reduced."""

_CROP_SIDE = 240
"""Longest side of a crop, pixels."""


def _save(picture: Image.Image, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, encode_image(picture, "JPEG", quality=85, subsampling=0))


def draw_judged(color: NDArray[np.uint8], labels: NDArray[Any], judged: Sequence[Annotation], path: Path) -> None:
    """Draw the outline and the text of every judged instance (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        labels: [H, W] integers.
        judged: instances, green if correct and red if incorrect; texts are placed in this order. Labels without a pixel
            are skipped.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    step = max(1, math.ceil(labels.shape[1] / _LARGEST_WIDTH))
    color, labels = color[::step, ::step], labels[::step, ::step]
    _save(draw_instances(color, labels, [each for each in judged if (labels == each.label).any()]), path)


def draw_crop(color: NDArray[np.uint8], mask: NDArray[np.bool_], path: Path) -> None:
    """Draw an instance with its outline in red and a margin around it (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        mask: [H, W] bool, the pixels of the instance; not empty.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = 6 + max(np.ptp(rows), np.ptp(columns)) // 8
    window = tuple(slice(max(0, int(s[0]) - margin), int(s[-1]) + margin + 1) for s in (rows, columns))
    picture = draw_instances(color[window], mask[window].astype(np.uint8), [Annotation(1, INCORRECT, "")])
    scale = _CROP_SIDE / max(picture.size)
    _save(picture.resize((max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))), path)
