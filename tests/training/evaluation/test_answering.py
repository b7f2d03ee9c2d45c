"""Answers to frames in memory, with a stand-in for the recognizer."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import ToyDescriptors, UntaughtRecognizer

import thor2_jax as thor2
from training.evaluation.answering import answer_frames
from training.evaluation.results import compute_results, fuse_answers
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame


class ToyRecognizer(UntaughtRecognizer):
    """Stand-in for a recognizer: the k-th usable instance of a frame has row k of the given probabilities."""

    def __init__(
        self, labels: list[int], unusable: dict[int, str], probabilities: dict[str, list[list[float]]]
    ) -> None:
        super().__init__(("mug", "bowl", "can"), ("tops", "tops2"))
        self.instances = [
            SimpleNamespace(label=label, reason=unusable.get(label), occluded=label == 4) for label in labels
        ]
        self.table = {name: np.array(rows) for name, rows in probabilities.items()}

    def describe(self, frame: Any) -> Any:
        usable = [instance for instance in self.instances if instance.reason is None]
        return SimpleNamespace(instances=self.instances, usable=usable, oriented=ToyDescriptors(None))

    def probabilities(self, oriented: Any) -> dict[str, np.ndarray]:
        return self.table


def test_every_labelled_instance_gets_an_answer() -> None:
    """Labels 2, 4 and 7 are rows 0, 1 and 2; 9 is unusable, 11 an unknown object, 12 has no pixels."""
    images = thor2.RGBDFrame(
        np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.uint16), np.zeros((4, 4), np.uint8),
        thor2.Intrinsics(1.0, 1.0, 0.0, 0.0),
    )  # fmt: skip
    truth = {7: "bowl", 2: "mug", 4: "can", 9: "mug", 11: "dragon", 12: "can"}
    frame = LabelledFrame("f1", images, truth, {"light": "1"})
    recognizer: Any = ToyRecognizer(
        [2, 4, 7, 9, 11],
        {9: "too few points", 11: "too few points"},
        {
            "tops": [[0.6, 0.3, 0.1], [0.5, 0.4, 0.1], [0.2, 0.7, 0.1], [1, 0, 0]],
            "tops2": [[0.1, 0.7, 0.2], [0.1, 0.1, 0.8], [0.3, 0.4, 0.3], [1, 0, 0]],
        },
    )
    run = Run("run", "", recognizer)
    ((item, answers),) = answer_frames([run], [frame])
    assert item is frame and answers.frame == "f1" and answers.attributes == {"light": "1"}
    assert [(i.label, i.truth, i.reason, i.occluded) for i in answers.instances] == [
        (2, "mug", None, False),
        (4, "can", None, True),
        (7, "bowl", None, False),
        (9, "mug", "too few points", False),
        (11, "dragon", "too few points", False),
        (12, "can", "no pixels in the label image", False),
    ]
    predictions = fuse_answers(answers.instances, [run])
    for fusion, names, confidence in (
        ("TOPS", ["mug", "mug", "bowl"], [0.6, 0.5, 0.7]),
        ("TOPS2", ["bowl", "can", "bowl"], [0.7, 0.8, 0.4]),
        ("THOR2", ["bowl", "can", "bowl"], [0.5426, 0.4004, 0.5586]),
    ):
        assert [run.classes[k] for k in predictions[fusion][0].class_index] == names
        assert predictions[fusion][0].confidence == pytest.approx(confidence, abs=1e-4)
    report = compute_results("frames", [run], [answers])
    assert report["instances"]["scored"] == 5 and report["instances"]["no_class"] == {"dragon": 1}
    cell = report["accuracy"]["log-mean"][0]["cells"][0]
    assert {name: value["mean"] for name, value in cell["accuracy"].items()} == {
        "TOPS": 0.4, "TOPS2": 0.4, "THOR2": 0.4,
    }  # fmt: skip


def test_no_frames_give_no_answers() -> None:
    recognizer: Any = ToyRecognizer([], {}, {})
    assert list(answer_frames([Run("run", "", recognizer)], [])) == []
