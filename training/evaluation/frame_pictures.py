"""Pictures of an evaluation, drawn while the frames are in memory."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from training.evaluation.answers import EvaluatedRun, FrameAnswers
from training.evaluation.fusion import main_fusion
from training.evaluation.results import fuse_answers, incorrect_answers
from training.readers.labelled import LabelledFrame
from training.reports.instance_pictures import draw_crop, draw_judged

__all__ = ["FramePictures"]

FRAMES = 12
"""Number of frames drawn, evenly spread over the dataset."""


class FramePictures:
    """Pictures of some frames with the answers of the first run, and of the most confident instance of each confusion.

    They are `frames/<number>.jpg`, counted from 0, and `confusions/<truth>-<prediction>.jpg` with class indices.

    Attributes:
        shown: numbers of the frames that are drawn.
    """

    def __init__(self, out: Path, runs: Sequence[EvaluatedRun], n_frames: int) -> None:
        """Create the directories in `out`.

        Args:
            out: directory of the report.
            runs: evaluated runs.
            n_frames: number of frames of the dataset.

        Raises:
            OSError: a directory cannot be created.
        """
        self._out, self._runs, self._classes = out, runs, runs[0].classes
        self.shown = sorted({int(n) for n in np.linspace(0, n_frames - 1, FRAMES)})
        self._highest: dict[tuple[str, str], float] = {}
        for name in ("frames", "confusions"):
            (out / name).mkdir(parents=True, exist_ok=True)

    def frame_path(self, number: int) -> Path:
        """Return the path of the picture of a frame."""
        return self._out / "frames" / f"{number}.jpg"

    def confusion_path(self, truth: str, prediction: str) -> Path:
        """Return the path of the picture of a confusion."""
        return self._out / "confusions" / f"{self._classes.index(truth)}-{self._classes.index(prediction)}.jpg"

    def restore(self, answers: FrameAnswers) -> None:
        """Take into account a frame that was drawn before the evaluation was interrupted."""
        for instance, prediction, confidence in incorrect_answers(answers, self._runs):
            pair = instance.truth, prediction
            self._highest[pair] = max(confidence, self._highest.get(pair, -1.0))

    def draw(self, number: int, item: LabelledFrame, answers: FrameAnswers) -> None:
        """Draw the frame if it is shown, and those of its incorrect answers that are the most confident so far.

        Raises:
            OSError: a file cannot be written.
        """
        for instance, prediction, confidence in incorrect_answers(answers, self._runs):
            if confidence > self._highest.get((instance.truth, prediction), -1.0):
                self._highest[instance.truth, prediction] = confidence
                mask = item.frame.label_image == instance.label
                draw_crop(item.frame.color, mask, self.confusion_path(instance.truth, prediction))
        if number in self.shown:
            draw_judged(item.frame.color, item.frame.label_image, self._judge(answers), self.frame_path(number))

    def _judge(self, answers: FrameAnswers) -> dict[int, tuple[bool, str]]:
        """Return label -> (correct, text) for the instances of known objects."""
        known = [i for i in answers.instances if i.truth in self._classes]
        judged = {i.label: (False, f"none ({i.truth})") for i in known}
        described = [i for i in known if i.probabilities is not None]
        predictions = fuse_answers(described, self._runs)
        first = next(iter(predictions[main_fusion(predictions, self._runs[0].answer_by)].values()))
        for instance, index in zip(described, first.class_index, strict=True):
            name = self._classes[index]
            correct = name == instance.truth
            judged[instance.label] = correct, name if correct else f"{name} ({instance.truth})"
        return judged
