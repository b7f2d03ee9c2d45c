"""What every classifier of every run says of every labelled instance, kept frame by frame as it comes.

`answers.jsonl`: the first line tells what was asked, each further line holds a frame. A file that a crash cut off is
good up to its last whole line. The digests in the lines of version 0.1.0 are not read.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from training.baselines.baseline import seen_in
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame
from training.storage.jobs import check_same_job

__all__ = ["AnswerFile", "FrameAnswers", "InstanceAnswer", "answer_frame", "columns"]


@dataclasses.dataclass(frozen=True, eq=False)
class InstanceAnswer:
    """What is said of one labelled instance.

    Attributes:
        label: its number in the label image.
        truth: its name; may be no class of the runs.
        occluded: by the recognizer's rule.
        reason: why it could not be described; None if it was.
        probabilities: [M, C] float32, a row a classifier or baseline in the order of `columns`; None if it was not
            described.
    """

    label: int
    truth: str
    occluded: bool = False
    reason: str | None = None
    probabilities: NDArray[np.float32] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class FrameAnswers:
    """What is said of a frame.

    Attributes:
        frame: its identifier.
        attributes: those of the reader.
        seconds: to read, describe and classify it.
        instances: the labelled ones, by label number.
    """

    frame: str
    attributes: Mapping[str, str]
    seconds: float
    instances: Sequence[InstanceAnswer]


def columns(runs: Sequence[Run]) -> tuple[tuple[int, str], ...]:
    """(Number of the run, name) of every classifier and baseline at hand."""
    return tuple((r, name) for r, run in enumerate(runs) for name in run.asked)


def answer_frame(runs: Sequence[Run], item: LabelledFrame) -> list[InstanceAnswer]:
    """Describe a frame once, with the first recognizer, and classify it with all classifiers and baselines."""
    described = runs[0].recognizer.describe(item.frame)
    compared = any(run.baselines for run in runs)
    seen = seen_in(described, runs[0].recognizer.run.config) if compared else None
    found = [run.probabilities(item.identifier, described, seen) for run in runs]
    table = np.stack([found[r][name] for r, name in columns(runs)], axis=1)  # [B, M, C]
    rows = {instance.label: row for row, instance in enumerate(described.usable)}
    reasons = {instance.label: instance.reason for instance in described.instances}
    answers = []
    for label, truth in sorted(item.truth.items()):
        if label in rows:
            row = rows[label]
            answers.append(InstanceAnswer(label, truth, described.usable[row].occluded, None, table[row]))
        else:
            reason = reasons.get(label) or "no pixels in the label image"
            answers.append(InstanceAnswer(label, truth, reason=reason))
    return answers


class AnswerFile:
    """Answers on disk: those so far, and one more frame at a time.

    Attributes:
        frames: the answers so far. Probabilities have six digits, also those of a frame just added, so that an
            evaluation that was stopped and one that was not give the same.
    """

    def __init__(self, path: Path, asked: Mapping[str, Any]) -> None:
        """Begin the file, or go on with it.

        Args:
            path: of the file; its folder is made if it is missing.
            asked: what the answers depend on, as JSON holds it.

        Raises:
            InputError: a file of something else than `asked`, or a damaged one.
            OSError: it cannot be read or written.
        """
        self._path = path
        self.frames: list[FrameAnswers] = []
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(asked) + "\n")
            return
        content = path.read_bytes()
        whole = content.rfind(b"\n") + 1
        try:
            first, *lines = content[:whole].splitlines() or [b""]
            found = dict(json.loads(first))
            self.frames = [_decoded(line) for line in lines]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"out: {path} is damaged ({error}); remove it to begin again") from None
        check_same_job(path.parent, found, asked)
        if whole < len(content):
            with path.open("r+b") as file:
                file.truncate(whole)

    def append(self, answers: FrameAnswers) -> None:
        """Add a frame."""
        line = _encoded(answers)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self.frames.append(_decoded(line))


def _encoded(answers: FrameAnswers) -> str:
    instances = [
        {
            **{f.name: getattr(i, f.name) for f in dataclasses.fields(i)},
            "probabilities": None
            if i.probabilities is None
            else [[float(f"{p:.6g}") for p in row] for row in i.probabilities],
        }
        for i in answers.instances
    ]
    frame = {
        "frame": answers.frame,
        "attributes": dict(answers.attributes),
        "seconds": round(answers.seconds, 4),
        "instances": instances,
    }
    return json.dumps(frame)


def _decoded(line: str | bytes) -> FrameAnswers:
    values = json.loads(line)
    instances = []
    for instance in values["instances"]:
        if instance["probabilities"] is not None:
            instance["probabilities"] = np.array(instance["probabilities"], np.float32)
            if instance["probabilities"].ndim != 2:
                raise ValueError(f"the probabilities of frame {values['frame']!r} are not a table")
        instances.append(InstanceAnswer(**instance))
    return FrameAnswers(values["frame"], values["attributes"], values["seconds"], instances)
