"""Class probabilities of every classifier for every labelled instance, and the file that keeps them.

The first line of `answers.jsonl` describes the evaluation; each further line holds the answers for one frame. A line
that an interrupted evaluation left incomplete is removed when the evaluation resumes. The digests of version 0.1.0 are
ignored.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import errors_name, write_text
from training.storage.jobs import check_same_job

if TYPE_CHECKING:
    from training.evaluation.runs import Run

__all__ = ["AnswerFile", "FrameAnswers", "InstancePrediction", "all_predictors", "read_answers"]


def all_predictors(runs: Sequence["Run"]) -> tuple[tuple[int, str], ...]:
    """Return (index of the run, name) of every classifier and baseline of all runs."""
    return tuple((index, name) for index, run in enumerate(runs) for name in run.predictors)


@dataclasses.dataclass(frozen=True, eq=False)
class InstancePrediction:
    """Class probabilities for one labelled instance.

    Attributes:
        label: label number in the label image.
        truth: name of the object, which may be none of the classes.
        occluded: the recognizer found the instance to be occluded.
        reason: why the instance could not be described; None if it was.
        probabilities: [M, C] float32, one row for each of `all_predictors`; None if the instance was not described.
        position: median x, y and z of its points in the camera frame, metres; None if no pixel has depth, and in
            answers of earlier versions.
    """

    label: int
    truth: str
    occluded: bool = False
    reason: str | None = None
    probabilities: NDArray[np.float32] | None = None
    position: tuple[float, float, float] | None = None


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
        frames: answers so far. Probabilities are rounded to six digits, also those of a frame just appended, so that a
            resumed evaluation gives the same results as an uninterrupted one.
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
        try:
            first, *lines = content[:complete].splitlines() or [b""]
            stored = dict(json.loads(first))
            self.frames = [_decode(line) for line in lines]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"out: {path} is damaged ({error}); delete it to start again") from None
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
    """Read the answers of a finished evaluation.

    Raises:
        InputError: the file is missing or damaged.
    """
    try:
        return [_decode(line) for line in path.read_bytes().splitlines()[1:]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} cannot be read ({error}); expected the answers of a finished evaluation") from None


def _encode(answers: FrameAnswers) -> str:
    instances = [
        {
            **{f.name: getattr(i, f.name) for f in dataclasses.fields(i)},
            "probabilities": None
            if i.probabilities is None
            else [[float(f"{p:.6g}") for p in row] for row in i.probabilities],
        }
        for i in answers.instances
    ]
    values = {
        "frame": answers.frame,
        "attributes": dict(answers.attributes),
        "seconds": round(answers.seconds, 4),
        "files": dict(answers.files),
        "instances": instances,
    }
    return json.dumps(values)


def _decode(line: str | bytes) -> FrameAnswers:
    values = json.loads(line)
    instances = []
    for instance in values["instances"]:
        if instance["probabilities"] is not None:
            instance["probabilities"] = np.array(instance["probabilities"], np.float32)
            if instance["probabilities"].ndim != 2:
                raise ValueError(f"the probabilities of frame {values['frame']!r} are not a table")
        if instance.get("position") is not None:
            x, y, z = map(float, instance["position"])
            instance["position"] = x, y, z
        instances.append(InstancePrediction(**instance))
    files = dict(values.get("files", {}))
    return FrameAnswers(values["frame"], values["attributes"], values["seconds"], instances, files)
