"""Pictures that are taken while a dataset is gone through, so that no frame is read twice."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from training.evaluation.answers import FrameAnswers
from training.evaluation.fusion import main_joining
from training.evaluation.results import answered, wrong_answers
from training.readers.labelled import LabelledFrame
from training.reports.instance_pictures import draw_crop, draw_judged

__all__ = ["Gallery"]

SHOWN = 12
"""Frames in the gallery, spread over the dataset."""


class Gallery:
    """Some frames with the first run's answers, and for every confusion its most confident instance.

    `frames/<number>.jpg`, counted from 0; `confusions/<truth>-<answer>.jpg`, numbers of the classes.
    """

    def __init__(self, out: Path, columns: Sequence[tuple[int, str]], classes: Sequence[str], frames: int) -> None:
        """Pictures in `out` of a dataset of so many frames; answers are in the order of `columns`."""
        self._out, self._columns, self._classes = out, columns, classes
        self.shown = sorted({int(n) for n in np.linspace(0, frames - 1, SHOWN)})
        self._most: dict[tuple[str, str], float] = {}
        for folder in ("frames", "confusions"):
            (out / folder).mkdir(parents=True, exist_ok=True)

    def frame(self, number: int) -> Path:
        """The picture of a frame."""
        return self._out / "frames" / f"{number}.jpg"

    def confusion(self, truth: str, answer: str) -> Path:
        """The picture of a confusion."""
        return self._out / "confusions" / f"{self._classes.index(truth)}-{self._classes.index(answer)}.jpg"

    def recall(self, frame: FrameAnswers) -> None:
        """Take note of a frame whose pictures are there already."""
        for instance, answer, confidence in wrong_answers(frame, self._columns, self._classes):
            pair = instance.truth, answer
            self._most[pair] = max(confidence, self._most.get(pair, -1.0))

    def add(self, number: int, item: LabelledFrame, frame: FrameAnswers) -> None:
        """Draw what is worth it of a frame.

        Raises:
            OSError: a file cannot be written.
        """
        for instance, answer, confidence in wrong_answers(frame, self._columns, self._classes):
            if confidence > self._most.get((instance.truth, answer), -1.0):
                self._most[instance.truth, answer] = confidence
                mask = item.frame.labels == instance.label
                draw_crop(item.frame.color, mask, self.confusion(instance.truth, answer))
        if number in self.shown:
            draw_judged(item.frame.color, item.frame.labels, self._judged(frame), self.frame(number))

    def _judged(self, frame: FrameAnswers) -> dict[int, tuple[bool, str]]:
        known = [i for i in frame.instances if i.truth in self._classes]
        judged = {i.label: (False, f"none ({i.truth})") for i in known}
        described = [i for i in known if i.probabilities is not None]
        found = answered(described, self._columns)
        first = next(iter(found[main_joining(found)].values()))
        for instance, index in zip(described, first.answer, strict=True):
            answer = self._classes[index]
            right = answer == instance.truth
            judged[instance.label] = right, answer if right else f"{answer} ({instance.truth})"
        return judged
