"""Answers to frames in memory, with a stand-in for the recognizer."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from helpers import ToyDescriptors, UntaughtRecognizer, small_frame

import thor2_jax as thor2
from training.evaluation.answering import answer_frames
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame


class ToyRecognizer(UntaughtRecognizer):
    """Stand-in for a recognizer: the k-th usable instance of a frame has row k of the given probabilities."""

    def __init__(self, labels: list[int], unusable: dict[int, str], probabilities: dict[str, Any]) -> None:
        super().__init__(("mug", "bowl", "can"), ("tops", "tops2"))
        self.instances = [SimpleNamespace(label=k, reason=unusable.get(k), occluded=k == 4) for k in labels]
        self.table = {name: np.array(rows) for name, rows in probabilities.items()}

    def describe(self, frame: Any) -> Any:
        usable = [instance for instance in self.instances if instance.reason is None]
        return SimpleNamespace(instances=self.instances, usable=usable, oriented=ToyDescriptors(None))

    def probabilities(self, oriented: Any) -> dict[str, np.ndarray]:
        return self.table


def test_every_labelled_instance_gets_an_answer() -> None:
    """Labels 2, 4 and 7 are rows 0, 1 and 2; 9 is unusable, 11 an unknown object, 12 has no pixels."""
    truth = {7: "bowl", 2: "mug", 4: "can", 9: "mug", 11: "dragon", 12: "can"}
    frame = LabelledFrame("f1", small_frame(), truth, {"light": "1"})
    tops = [[0.6, 0.3, 0.1], [0.5, 0.4, 0.1], [0.2, 0.7, 0.1], [1, 0, 0]]
    tops2 = [[0.1, 0.7, 0.2], [0.1, 0.1, 0.8], [0.3, 0.4, 0.3], [1, 0, 0]]
    unusable = dict.fromkeys((9, 11), "too few points")
    recognizer: Any = ToyRecognizer([2, 4, 7, 9, 11], unusable, {"tops": tops, "tops2": tops2})
    ((item, answers),) = answer_frames([Run("run", "", recognizer)], [frame])
    assert item is frame and answers.frame == "f1" and answers.attributes == {"light": "1"}
    assert [(i.label, i.truth, i.reason, i.occluded) for i in answers.instances] == [
        (2, "mug", None, False),
        (4, "can", None, True),
        (7, "bowl", None, False),
        (9, "mug", "too few points", False),
        (11, "dragon", "too few points", False),
        (12, "can", "no pixels in the label image", False),
    ]
    for instance, expected in zip(answers.instances, zip(tops, tops2, strict=True), strict=False):
        if instance.reason is None:
            np.testing.assert_allclose(instance.probabilities, expected, rtol=1e-6)
        else:
            assert instance.probabilities is None


def test_position_is_the_median_of_the_points() -> None:
    """Two pixels at 2 m and one at 9 m, which belongs to the background; one without depth does not count."""
    depth, labels = np.zeros((2, 3, 5), np.uint16)
    depth[1, 1:4] = 2000, 2000, 9000
    labels[1], labels[2, 0] = [0, 1, 1, 1, 1], 2
    frame = thor2.RGBDFrame(np.zeros((3, 5, 3), np.uint8), depth, labels, thor2.Intrinsics(10.0, 10.0, 0.0, 0.0))
    recognizer: Any = ToyRecognizer([], {}, {"tops": np.zeros((0, 3)), "tops2": np.zeros((0, 3))})
    truth = dict.fromkeys((1, 2, 3), "mug")
    ((_, answers),) = answer_frames([Run("run", "", recognizer)], [LabelledFrame("f", frame, truth, {})])
    assert [instance.position for instance in answers.instances] == [(0.4, 0.2, 2.0), None, None]
