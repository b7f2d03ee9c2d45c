"""Answering labelled frames with the classifiers and baselines of several runs."""

import time
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from thor2_jax.recognition.frames import RGBDFrame, pixel_rays
from training.baselines.baseline import baseline_inputs
from training.evaluation.answers import FrameAnswers, InstancePrediction, all_predictors
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame

__all__ = ["NO_PIXELS", "answer_frames"]

NO_PIXELS = "no pixels in the label image"
"""Why an instance that the labels name could not be described."""


def answer_frames(runs: Sequence[Run], frames: Iterable[LabelledFrame]) -> Iterator[tuple[LabelledFrame, FrameAnswers]]:
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


def _answer(runs: Sequence[Run], item: LabelledFrame) -> list[InstancePrediction]:
    recognizer = runs[0].recognizer
    described = recognizer.describe(item.frame)
    baselines = any(run.baselines for run in runs)
    inputs = baseline_inputs(described, recognizer.run.config, item.frame) if baselines else None
    values = [run.probabilities(item.identifier, described, inputs) for run in runs]
    table = np.stack([values[index][name] for index, name in all_predictors(runs)], axis=1)  # [B, M, C]
    rows = {instance.label: row for row, instance in enumerate(described.usable)}
    reasons = {instance.label: instance.reason for instance in described.instances}
    answers = []
    for label, truth in sorted(item.truth.items()):
        position = _position(item.frame, label)
        if label in rows:
            row = rows[label]
            occluded = described.usable[row].occluded
            answers.append(InstancePrediction(label, truth, occluded, None, table[row], position))
        else:
            reason = reasons.get(label) or NO_PIXELS
            answers.append(InstancePrediction(label, truth, reason=reason, position=position))
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
