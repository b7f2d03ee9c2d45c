"""Answering labelled frames with the classifiers and baselines of several runs."""

import contextlib
import dataclasses
import functools
import time
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path

import numpy as np

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame, pixel_rays
from thor2_jax.printable import find_name
from training.baselines.baseline import baseline_inputs
from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.evaluation.runs import Run, all_predictors, load_runs, load_sequence_runs
from training.readers.labelled import LabelledFrame, LabelledFrames
from training.storage.workers import WorkerPool

__all__ = ["NO_PIXELS", "answer_frames", "answer_frames_in_pool", "load_evaluated"]

NO_PIXELS = "no pixels in the label image"
"""Why an instance that the labels name could not be described."""

Load = tuple[tuple[Path, ...], tuple[str, ...] | None]
"""Arguments of `load_evaluated`."""

FRAMES_PER_CHUNK = 4
"""Frames that a worker answers at a time, and that are answered again if it dies."""


def answer_frames(
    runs: Sequence[Run], frames: Iterable[LabelledFrame]
) -> Generator[tuple[LabelledFrame, FrameAnswers], None, None]:
    """Yield every frame with its answers; a frame is described once for all runs.

    Args:
        runs: runs that share classes, descriptor and colour network, see `load_runs`.
        frames: frames in memory, or an iterable that reads them.

    Raises:
        InputError: a frame cannot be read.
    """
    start = time.perf_counter()
    for item in frames:
        instances = _answer(runs, item)
        yield item, FrameAnswers(item.identifier, item.attributes, time.perf_counter() - start, instances)
        start = time.perf_counter()


def load_evaluated(models: tuple[Path, ...], sequences: tuple[str, ...] | None = None) -> Sequence[Run]:
    """Load the runs of an evaluation.

    Args:
        models: see `load_runs`; with `sequences`, the directory of `load_sequence_runs`.
        sequences: identifiers of the frames if there is a run for each sequence; None otherwise.

    Raises:
        InputError: as these functions, or for several directories of sequences.
    """
    if sequences is None:
        return load_runs(models)
    if len(models) != 1:
        raise InputError(
            f"per_sequence: {len(models)} models are given; expected one directory with a run per sequence"
        )
    return load_sequence_runs(models[0], sequences)


def answer_frames_in_pool(
    load: Load, frames: LabelledFrames, pool: WorkerPool, numbers: range
) -> Generator[tuple[LabelledFrame, FrameAnswers], None, None]:
    """Yield the frames of these numbers with the answers of `answer_frames`, which workers compute in chunks.

    Frames before one that cannot be read are yielded before its error is raised.

    Args:
        load: arguments of `load_evaluated`, by which each worker process loads the runs.
        frames: the dataset.
        pool: the workers.
        numbers: numbers of the frames.

    Raises:
        InputError: as `answer_frames`.
        OSError: a file cannot be opened, or workers die repeatedly.
    """
    starts = range(0, len(numbers), FRAMES_PER_CHUNK)
    chunks = [(load, frames, numbers[start : start + FRAMES_PER_CHUNK]) for start in starts]
    with contextlib.closing(pool(_answer_chunk, chunks)) as results:
        for answered, error in results:
            yield from answered
            if error is not None:
                raise error


_loaded = functools.lru_cache(1)(load_evaluated)
"""Loads the runs once in a worker process."""


def _answer_chunk(
    chunk: tuple[Load, LabelledFrames, range],
) -> tuple[list[tuple[LabelledFrame, FrameAnswers]], Exception | None]:
    load, frames, numbers = chunk
    runs, answered = _loaded(*load), []
    try:
        for item, answers in answer_frames(runs, (frames[n] for n in numbers)):
            frame = dataclasses.replace(item.frame)  # without its cached properties
            answered.append((dataclasses.replace(item, frame=frame), answers))
    except (InputError, OSError) as error:
        return answered, error
    return answered, None


def _answer(runs: Sequence[Run], item: LabelledFrame) -> list[InstancePrediction]:
    recognizer = runs[0].recognizer
    described = recognizer.describe(item.frame)
    has_baselines = any(run.baselines for run in runs)
    inputs = baseline_inputs(described, recognizer.run.config, item.frame) if has_baselines else None
    values = [run.probabilities(item.identifier, described, inputs) for run in runs]
    table = np.stack([values[index][name] for index, name in all_predictors(runs)], axis=1)  # [B, M, C]
    rows = {instance.label: row for row, instance in enumerate(described.usable)}
    reasons = {instance.label: instance.reason for instance in described.instances}
    answers = []
    for label, name in sorted(item.truth.items()):
        truth, position = find_name(name, runs[0].classes) or name, _position(item.frame, label)
        if (row := rows.get(label)) is None:
            reason = reasons.get(label) or NO_PIXELS
            answers.append(InstancePrediction(label, truth, reason=reason, position=position))
        else:
            occluded = described.usable[row].occluded
            answers.append(InstancePrediction(label, truth, occluded, None, table[row], position))
    return answers


def _position(frame: RGBDFrame, label: int) -> tuple[float, float, float] | None:
    """Return the median x, y and z of an instance's points, rounded to 0.1 mm; None if no pixel has depth."""
    pixels = frame.instance_pixels.get(label, np.zeros(0, np.intp))
    depth = frame.depth_m.ravel()[pixels]
    pixels, depth = pixels[depth > 0], depth[depth > 0]
    if not len(pixels):
        return None
    points = pixel_rays(pixels, frame.depth.shape[1], frame.intrinsics) * depth[:, None]
    x, y, z = np.median(points, axis=0).round(4).tolist()
    return x, y, z
