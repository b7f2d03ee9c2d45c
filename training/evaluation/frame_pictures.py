"""Pictures of an evaluation, drawn while the frames are in memory: frames with judged answers, and instance crops."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.files import atomic_write
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, Annotation, draw_instances
from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.evaluation.results import named_answers
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame

__all__ = ["CORRECT", "FramePictures", "INCORRECT", "draw_crop", "draw_judged"]

FRAMES = 12
"""Number of frames drawn, evenly spread over the dataset."""


class FramePictures:
    """Pictures of some frames with the answers of the first run, and of the most confident instance of each confusion.

    The files are `frames/<number>.jpg`, counted from 0, and `confusions/<truth>-<name>.jpg` with class indices; unknown
    objects have the indices after the classes.

    Attributes:
        shown: numbers of the frames that are drawn.
    """

    def __init__(self, out: Path, runs: Sequence[Run], n_frames: int) -> None:
        """Create the directories in `out`.

        Args:
            out: directory of the report.
            runs: evaluated runs.
            n_frames: number of frames of the dataset.

        Raises:
            OSError: a directory cannot be created.
        """
        self._out, self._runs, self._names = out, runs, list(runs[0].classes)
        self.shown = sorted({int(n) for n in np.linspace(0, n_frames - 1, FRAMES)})
        self._highest: dict[tuple[str, str], float] = {}
        for name in ("frames", "confusions"):
            (out / name).mkdir(parents=True, exist_ok=True)

    def frame_path(self, number: int) -> Path:
        """Return the path of the picture of a frame."""
        return self._out / "frames" / f"{number}.jpg"

    def confusion_path(self, truth: str, name: str) -> Path:
        """Return the path of the picture of an object that is recognized as another one."""
        return self._out / "confusions" / f"{self._names.index(truth)}-{self._names.index(name)}.jpg"

    def draw(self, number: int, item: LabelledFrame, answers: FrameAnswers) -> None:
        """Draw the frame if it is shown, and its confusions that are the most confident ones so far.

        Raises:
            OSError: a file cannot be written.
        """
        color, labels = item.frame.color, item.frame.label_image
        for instance, name in self.record(answers):
            draw_crop(color, labels == instance.label, self.confusion_path(instance.truth, name))
        if number in self.shown:
            draw_judged(color, labels, self._judge(answers), self.frame_path(number))

    def record(self, answers: FrameAnswers) -> list[tuple[InstancePrediction, str]]:
        """Record the confidences of a frame, which may have been drawn before the evaluation was interrupted.

        Returns:
            Instances with their wrong names; each is the most confident one so far of its confusion.
        """
        most_confident = []
        for _, instance, name, confidence in named_answers(answers.instances, self._runs):
            if instance.truth not in self._names:
                self._names.append(instance.truth)
            if name in (None, instance.truth) or confidence <= self._highest.get((instance.truth, str(name)), -1.0):
                continue
            self._highest[instance.truth, str(name)] = confidence
            most_confident.append((instance, str(name)))
        return most_confident

    def _judge(self, answers: FrameAnswers) -> list[Annotation]:
        """Return the answers of the first run, incorrect ones first; unknown objects should be rejected."""
        names = {i.label: name for run, i, name, _ in named_answers(answers.instances, self._runs) if run == 0}
        judged = []
        for instance in answers.instances:
            name, is_known = names.get(instance.label), instance.truth in self._runs[0].classes
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
    with atomic_write(path) as temporary:
        picture.save(temporary, format="JPEG", quality=85, subsampling=0)


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
