"""Class probabilities of every classifier for every labelled instance, the file that stores them, and their fusion.

The first line of `answers.jsonl` describes the evaluation; each of the other lines holds the answers for one frame. If
an interrupted evaluation left an incomplete line, it is removed when the evaluation resumes. Digests in files of
version 0.1.0 are ignored.
"""

import dataclasses
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import decoding
from thor2_jax.files import errors_name, write_text
from thor2_jax.model.fusion import FUSION_RULES, FusionRule, fused_probabilities, with_temperature
from thor2_jax.networks.networks import EMBEDDING, FEATURES
from training.baselines.job import TITLES
from training.storage.jobs import check_same_job

__all__ = [
    "ALL_CLASSIFIERS",
    "AnswerFile",
    "BOTH",
    "FrameAnswers",
    "GALLERY",
    "InstancePrediction",
    "Predictions",
    "RULES",
    "Rule",
    "fusions",
    "main_fusion",
    "read_answers",
]


@dataclasses.dataclass(frozen=True, eq=False)
class InstancePrediction:
    """Class probabilities for one labelled instance.

    Attributes:
        label: label number in the label image.
        truth: name of the object, which may not be one of the classes.
        occluded: whether the recognizer judged the instance to be occluded.
        reason: why the instance could not be described; None if it was.
        probabilities: [M, C] float32, one row for each predictor of the runs; None if the instance was not described.
        position: median x, y and z of its points in the camera frame, metres; None if no pixel has depth, and in
            answers of earlier versions.
    """

    label: int
    truth: str
    occluded: bool = False
    reason: str | None = None
    probabilities: NDArray[np.float32] | None = None
    position: Sequence[float] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class FrameAnswers:
    """Answers for one frame.

    Attributes:
        frame: identifier of the frame.
        attributes: attributes given by the reader.
        seconds: time to read, describe and classify the frame.
        instances: labelled instances, ordered by label number.
        files: SHA-256 of each file that the frame was read from; empty in answers of version 0.1.0.
    """

    frame: str
    attributes: Mapping[str, str]
    seconds: float
    instances: Sequence[InstancePrediction]
    files: Mapping[str, str] = dataclasses.field(default_factory=dict)


class AnswerFile:
    """The file with the answers of an evaluation; frames are appended one at a time.

    Attributes:
        frames: answers so far. All probabilities are rounded to six digits, even those of a frame just appended, so
            that a resumed evaluation gives the same results as an uninterrupted one.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        """Create the file, or read it to resume an evaluation.

        Args:
            path: path of the file; its directory is created if it is missing.
            header: JSON values that determine the answers.

        Raises:
            InputError: the file is damaged, or its header differs.
            OSError: the file cannot be read or written.
        """
        self._path = path
        self.frames: list[FrameAnswers] = []
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(header) + "\n")
            return
        content = path.read_bytes()
        complete = content.rfind(b"\n") + 1
        with decoding(f"out: {path} is damaged", advice="delete it to start again"):
            first, *lines = content[:complete].splitlines() or [b""]
            stored = dict(json.loads(first))
            self.frames = [_decode(line) for line in lines]
        check_same_job(path.parent, stored, header)
        if complete < len(content):
            with path.open("r+b") as file:
                file.truncate(complete)

    def append(self, answers: FrameAnswers) -> None:
        """Append the answers for a frame.

        Raises:
            OSError: the file cannot be written.
        """
        line = _encode(answers)
        with errors_name(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self.frames.append(_decode(line))


def read_answers(path: Path) -> list[FrameAnswers]:
    """Read the answers of a finished evaluation."""
    return [_decode(line) for line in path.read_bytes().splitlines()[1:]]


def _encode(answers: FrameAnswers) -> str:
    instances = []
    for instance in answers.instances:
        table = instance.probabilities
        rounded = None if table is None else [[float(f"{p:.6g}") for p in row] for row in table]
        instances.append(vars(instance) | {"probabilities": rounded})
    return json.dumps(vars(answers) | {"seconds": round(answers.seconds, 4), "instances": instances})


def _decode(line: str | bytes) -> FrameAnswers:
    values = json.loads(line)
    instances = []
    for instance in values["instances"]:
        if instance["probabilities"] is not None:
            instance["probabilities"] = np.array(instance["probabilities"], np.float32)
            if instance["probabilities"].ndim != 2:
                raise ValueError(f"the probabilities of frame {values['frame']!r} are not a table")
        instances.append(InstancePrediction(**instance))
    files = dict(values.get("files", {}))
    return FrameAnswers(values["frame"], values["attributes"], values["seconds"], instances, files)


Rule = FusionRule | Literal["calibrated"]
RULES: tuple[Rule, ...] = (*FUSION_RULES, "calibrated")
"""The rules of `fused_probabilities`, and "calibrated": the rule "max" on temperature-scaled probabilities."""

ALL_CLASSIFIERS, GALLERY, BOTH = "classifiers", "gallery", "both"
"""Columns of the classifiers with the embedding's confidence, the gallery alone, and all."""

WITHOUT_RULE = (EMBEDDING, ALL_CLASSIFIERS, GALLERY, BOTH)
"""All columns that are computed without a fusion rule; the first one is the embedding alone."""


def fusions(available: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Return title -> names: each available baseline and the gallery alone, and every combination of classifiers.

    The titles are as in the paper: CE, TOPS, ..., THOR2 (TOPS and TOPS2).
    """
    names = set(available)
    features = [name for name in FEATURES if name in names]
    groups = [group for size in range(1, len(features) + 1) for group in itertools.combinations(features, size)]
    baselines: dict[str, tuple[str, ...]] = {title: (name,) for name, title in TITLES.items() if name in names}
    classifiers = {"THOR2" if group == ("tops", "tops2") else "+".join(group).upper(): group for group in groups}
    return baselines | classifiers | {name: (name,) for name in WITHOUT_RULE if name in names}


def main_fusion(titles: Iterable[str], answer_by: str = "classifiers") -> str:
    """Return the column whose answers the recognizer gives.

    Args:
        titles: the columns, at least one.
        answer_by: "classifiers", "gallery" or "both". If there is no column with this title, the column is the first
            available one of: THOR2, TOPS, TOPS2, the embedding, the last title (see `Model.chosen_classifiers`).
    """
    titles = list(titles)
    last = [title for title in titles if title not in WITHOUT_RULE][-1:]
    return next(title for title in (answer_by, "THOR2", "TOPS", "TOPS2", EMBEDDING, *last) if title in titles)


class Predictions(NamedTuple):
    """Predicted classes [N] and their fused probabilities [N]; -1 and 0 for instances that were not described."""

    class_index: NDArray[np.intp]
    confidence: NDArray[np.floating[Any]]

    @property
    def described(self) -> NDArray[np.bool_]:
        """[N], whether the instance was described."""
        return self.class_index >= 0

    @classmethod
    def fused(
        cls, rule: Rule, probabilities: Mapping[str, NDArray[np.floating[Any]]], temperatures: Mapping[str, float]
    ) -> "Predictions":
        """Return the predicted classes and their fused probabilities.

        Args:
            rule: fusion rule.
            probabilities: [B, C] class probabilities of each classifier.
            temperatures: temperature of each classifier; read for "calibrated" only.
        """
        if set(probabilities) <= set(WITHOUT_RULE):
            (values,) = probabilities.values()  # scores, which need not sum to 1
            return cls(values.argmax(axis=1), values.max(axis=1))
        if rule == "calibrated":
            scaled = {name: with_temperature(values, temperatures[name]) for name, values in probabilities.items()}
            return cls.fused("max", scaled, temperatures)
        fused = fused_probabilities(probabilities, rule)
        return cls(fused.argmax(axis=1), fused.max(axis=1))
