"""Recognizers without networks, whose answers a test determines."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

import thor2_jax as thor2
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.model.model import Model


class ToyDescriptors(NamedTuple):
    """Stands in for the descriptors of a frame; `content` is what the toy recognizer reads."""

    content: Any
    overflow: int = 0


class UntaughtRecognizer:
    """Base of toy recognizers, whose `probabilities` maps the content of `ToyDescriptors`; no object is enrolled."""

    unknown_below: float | None = None

    def __init__(self, classes: Sequence[str], features: Sequence[str] = ("tops",)) -> None:
        network = SimpleNamespace(fingerprint="")
        classifiers = dict.fromkeys(features)
        self.run: Any = SimpleNamespace(
            classes=tuple(classes), classifiers=classifiers, config=None, network=network, record={}
        )

    @property
    def model(self) -> Model:
        classifiers = {
            name: lambda oriented, name=name: self.probabilities(oriented.content)[name]
            for name in self.run.classifiers
        }
        return Model(self.run, classifiers, Gallery("", trained=self.run.classes), self.unknown_below)

    def describe(self, frame: thor2.RGBDFrame) -> Any:
        instances = [
            SimpleNamespace(label=label, reason=self.reason(label, frame), occluded=False) for label in frame.instances
        ]
        usable = [instance for instance in instances if instance.reason is None]
        return SimpleNamespace(instances=instances, usable=usable, oriented=ToyDescriptors(usable))

    def reason(self, label: int, frame: thor2.RGBDFrame) -> str | None:
        """Return why an instance cannot be used."""
        return None

    def probabilities(self, content: Any) -> dict[str, np.ndarray]:
        raise NotImplementedError


class NamesInOrder(UntaughtRecognizer):
    """Predicts the first class for the first usable instance of a frame and the second for all others."""

    def __init__(self, classes: Sequence[str] = ("mug", "bowl")) -> None:
        super().__init__(classes)

    def probabilities(self, usable: Sequence[Any]) -> dict[str, np.ndarray]:
        return {"tops": np.array([[0.9, 0.1] if k == 0 else [0.2, 0.8] for k in range(len(usable))]).reshape(-1, 2)}
