"""Recognizers without networks, whose answers a test determines, and runs without a recognizer."""

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import thor2_jax as thor2
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.model.model import Model
from training.evaluation.answers import InstancePrediction


class UntaughtRecognizer:
    """Base of toy recognizers, whose `probabilities` maps the content of the descriptors; no object is enrolled."""

    unknown_below: float | None = None
    probabilities: Any

    def __init__(self, classes: Sequence[str] = ("mug", "bowl"), features: Sequence[str] = ("tops",)) -> None:
        run = {"classes": tuple(classes), "classifiers": dict.fromkeys(features), "record": {}}
        self.run: Any = SimpleNamespace(**run, config=None, surfaces=None, network=SimpleNamespace(fingerprint=""))

    @property
    def model(self) -> Model:
        classifiers = {
            name: lambda oriented, name=name: self.probabilities(oriented.content)[name]
            for name in self.run.classifiers
        }
        return Model(self.run, classifiers, Gallery("", trained=self.run.classes), self.unknown_below)

    def describe(self, frame: thor2.RGBDFrame) -> Any:
        instances = [SimpleNamespace(label=k, reason=None, occluded=False, points=[]) for k in frame.instances]
        return described(instances, instances)


def described(instances: list[Any], content: Any, overflow: int = 0) -> Any:
    """Return descriptors of instances, with what the toy recognizer reads."""
    usable = [instance for instance in instances if instance.reason is None]
    oriented = SimpleNamespace(content=content, overflow=np.full(len(usable), overflow))
    return SimpleNamespace(instances=instances, usable=usable, oriented=oriented, packed=None)


class NamesInOrder(UntaughtRecognizer):
    """Predicts the first class for the first usable instance of a frame and the second for all others."""

    def probabilities(self, usable: Sequence[Any]) -> dict[str, np.ndarray]:
        return {"tops": np.array([[0.9, 0.1] if k == 0 else [0.2, 0.8] for k in range(len(usable))]).reshape(-1, 2)}


def recognizer_that_prefers(
    color: np.ndarray, classes: Sequence[str] = ("mug",), n: int | None = None, sharpness: float = 8.0
) -> Any:
    """Return a recognizer of n instances whose confidence falls with the distance of the colours."""

    def recognize(frame: thor2.RGBDFrame) -> list[thor2.Recognition]:
        distance = np.abs(frame.color.astype(float) - color).mean() / 255
        return [thor2.Recognition(label, "mug", float(np.exp(-sharpness * distance))) for label in frame.instances[:n]]

    return SimpleNamespace(recognize=recognize, classes=classes)


class ToyRun(NamedTuple):
    """The attributes of a run that results are computed from."""

    name: str
    predictors: tuple[str, ...] = ("tops",)
    classes: tuple[str, ...] = ("bowl", "can", "mug")
    temperatures: Mapping[str, float] = {}
    answer_by: str = "classifiers"
    thresholds: np.ndarray = np.zeros(3)  # noqa: RUF012
    baselines: Mapping[str, Any] = {}
    own_objects: bool = False
    has_real_views: bool = False


def toy_answer(truth: str, name: str | None, confidence: float = 0.6, n_predictors: int = 1) -> InstancePrediction:
    """Return an unmoved instance for which all predictors of a `ToyRun` have this confidence in a name.

    The other classes share the rest. An instance without a name has not been described.
    """
    if name is None:
        return InstancePrediction(1, truth, reason="too few points", position=(0.0, 0.0, 1.0))
    row = np.full(3, (1 - confidence) / 2, np.float32)
    row[ToyRun("").classes.index(name)] = confidence
    return InstancePrediction(1, truth, False, None, np.stack([row] * n_predictors), (0.0, 0.0, 1.0))
