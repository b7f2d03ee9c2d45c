"""Pictures of an evaluation, drawn while the frames are in memory."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.evaluation.results import named_answers
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame
from training.reports.instance_pictures import draw_crop, draw_judged

__all__ = ["FramePictures"]

FRAMES = 12
"""Number of frames drawn, evenly spread over the dataset."""


class FramePictures:
    """Pictures of some frames with the answers of the first run, and of the most confident instance of each wrong name.

    They are `frames/<number>.jpg`, counted from 0, and `confusions/<truth>-<name>.jpg` with class indices; unknown
    objects have the numbers after the classes.

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
        """Return the path of the picture of an object with a wrong name."""
        return self._out / "confusions" / f"{self._names.index(truth)}-{self._names.index(name)}.jpg"

    def restore(self, answers: FrameAnswers) -> None:
        """Take into account a frame that was drawn before the evaluation was interrupted."""
        for _ in self._most_confident(answers):
            pass

    def draw(self, number: int, item: LabelledFrame, answers: FrameAnswers) -> None:
        """Draw the frame if it is shown, and those of its wrong names that are the most confident so far.

        Raises:
            OSError: a file cannot be written.
        """
        for instance, name in self._most_confident(answers):
            draw_crop(
                item.frame.color, item.frame.label_image == instance.label, self.confusion_path(instance.truth, name)
            )
        if number in self.shown:
            draw_judged(item.frame.color, item.frame.label_image, self._judge(answers), self.frame_path(number))

    def _most_confident(self, answers: FrameAnswers) -> Iterator[tuple[InstancePrediction, str]]:
        """Yield instance and name of each wrong name that is more confident than all equal ones so far."""
        for _, instance, name, confidence in named_answers(answers.instances, self._runs):
            if instance.truth not in self._names:
                self._names.append(instance.truth)
            if name in (None, instance.truth) or confidence <= self._highest.get((instance.truth, str(name)), -1.0):
                continue
            self._highest[instance.truth, str(name)] = confidence
            yield instance, str(name)

    def _judge(self, answers: FrameAnswers) -> dict[int, tuple[bool, str]]:
        """Return label -> (correct, text) of what the first run answers; an unknown object should have no name."""
        names = {i.label: name for run, i, name, _ in named_answers(answers.instances, self._runs) if run == 0}
        judged = {}
        for instance in answers.instances:
            name = names.get(instance.label)
            correct = name == (instance.truth if instance.truth in self._runs[0].classes else None)
            text = name or ("unknown" if instance.label in names else "none")
            judged[instance.label] = correct, text if name == instance.truth else f"{text} ({instance.truth})"
        return judged
