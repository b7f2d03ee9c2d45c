"""Accuracy of toy answers that can be counted by hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import thor2_jax as thor2
from training.evaluate import Instance, evaluate, summarize
from training.readers.labelled import LabelledFrame


class ToyRecognizer:
    """Stands in for a trained one: instance k of a frame is row k, with the probabilities given."""

    run = SimpleNamespace(classes=("mug", "bowl", "can"), classifiers={"tops": None, "tops2": None})

    def __init__(
        self, labels: list[int], unusable: dict[int, str], probabilities: dict[str, list[list[float]]]
    ) -> None:
        self.instances = [
            SimpleNamespace(label=label, reason=unusable.get(label), occluded=label == 4) for label in labels
        ]
        self.table = {name: np.array(rows) for name, rows in probabilities.items()}

    def describe(self, frame: Any) -> Any:
        usable = [instance for instance in self.instances if instance.reason is None]
        return SimpleNamespace(instances=self.instances, usable=usable, descriptors=None)

    def probabilities(self, descriptors: Any) -> dict[str, np.ndarray]:
        return self.table


@pytest.fixture
def frame() -> LabelledFrame:
    images = thor2.RGBDFrame(
        np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.uint16), np.zeros((4, 4), np.uint8),
        thor2.Intrinsics(1.0, 1.0, 0.0, 0.0),
    )  # fmt: skip
    truth = {7: "bowl", 2: "mug", 4: "can", 9: "mug", 11: "dragon", 12: "can"}
    return LabelledFrame("f1", images, truth, {"light": "1"})


def test_each_instance_gets_the_answer_of_each_joining(frame: LabelledFrame) -> None:
    """Labels 2, 4, 7 are rows 0, 1, 2; 9 is unusable, 11 is of no class, 12 has no pixels."""
    recognizer = ToyRecognizer(
        [2, 4, 7, 9, 11],
        {9: "too few points", 11: "too few points"},
        {
            "tops": [[0.6, 0.3, 0.1], [0.5, 0.4, 0.1], [0.2, 0.7, 0.1], [1, 0, 0]],
            "tops2": [[0.1, 0.7, 0.2], [0.1, 0.1, 0.8], [0.3, 0.4, 0.3], [1, 0, 0]],
        },
    )
    told: list[str] = []
    found = evaluate(recognizer, [frame], told.append)  # type: ignore[arg-type]
    assert told == ["f1"]
    assert [(i.label, i.truth, i.reason, i.occluded) for i in found] == [
        (2, "mug", None, False),
        (4, "can", None, True),
        (7, "bowl", None, False),
        (9, "mug", "too few points", False),
        (11, "dragon", "no class of this run", False),
        (12, "can", "no pixels in the label image", False),
    ]
    expected = [
        {"TOPS": ("mug", 0.6), "TOPS2": ("bowl", 0.7), "THOR2": ("bowl", 0.5426)},
        {"TOPS": ("mug", 0.5), "TOPS2": ("can", 0.8), "THOR2": ("can", 0.4004)},
        {"TOPS": ("bowl", 0.7), "TOPS2": ("bowl", 0.4), "THOR2": ("bowl", 0.5586)},
    ]
    for one, answers in zip(found[:3], expected, strict=True):
        assert one.answers == {n: (name, pytest.approx(p, abs=1e-4)) for n, (name, p) in answers.items()}
    assert all(i.answers == {} for i in found[3:])
    assert all(i.frame == "f1" and i.attributes == {"light": "1"} for i in found)


def instance(truth: str, answer: str | None, light: str | None, reason: str | None = None) -> Instance:
    attributes = {} if light is None else {"light": light}
    answers = {} if answer is None else {"TOPS": (answer, 0.5), "THOR2": (truth, 0.9)}
    return Instance("f", 1, truth, attributes, answers, reason=reason)


def test_summary_against_counting_by_hand() -> None:
    instances = [
        instance("mug", "mug", "1"),
        instance("mug", "bowl", "1"),
        instance("bowl", "bowl", "2"),
        instance("bowl", None, "2", "too few points"),
        instance("can", "mug", None),
        instance("dragon", None, "2", "no class of this run"),
    ]
    found = summarize(instances, ["TOPS", "THOR2"])
    assert found == {
        "accuracy": {
            "all": {"all": {"instances": 5, "TOPS": 0.4, "THOR2": 0.8}},
            "light": {
                "1": {"instances": 2, "TOPS": 0.5, "THOR2": 1.0},
                "2": {"instances": 2, "TOPS": 0.5, "THOR2": 0.5},
            },
        },
        "scored": 5,
        "unanswered": 1,
        "not_scored": 1,
    }


def test_nothing_to_score() -> None:
    assert summarize([], ["TOPS"])["accuracy"] == {"all": {"all": {"instances": 0, "TOPS": None}}}
    assert evaluate(ToyRecognizer([], {}, {}), []) == []  # type: ignore[arg-type]
