"""Accuracy of one trained run on labelled frames in memory; `evaluation` does more, on datasets of any size.

Every joining of classifiers by the default rule, over all frames and by attribute.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from thor2_jax.recognition.fusion import DEFAULT_RULE
from thor2_jax.recognition.recognizer import Recognizer
from training.evaluation.accuracy import parts
from training.evaluation.answers import answer_frame
from training.evaluation.fusion import join_by, joinings
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrame

__all__ = ["Instance", "evaluate", "joinings", "summarize"]

NO_CLASS = "no class of this run"


@dataclasses.dataclass(frozen=True)
class Instance:
    """One labelled instance and what each joining of classifiers called it.

    Attributes:
        frame: identifier of its frame.
        label: its number there.
        truth: its name.
        attributes: those of its frame.
        answers: joining -> (name, confidence); empty if it could not be described.
        occluded: by the recognizer's rule.
        reason: why it could not be described, or that its name is no class of the run.
    """

    frame: str
    label: int
    truth: str
    attributes: Mapping[str, str]
    answers: Mapping[str, tuple[str, float]]
    occluded: bool = False
    reason: str | None = None


def evaluate(
    recognizer: Recognizer, frames: Iterable[LabelledFrame], progress: Callable[[str], object] = lambda identifier: None
) -> list[Instance]:
    """Recognize every labelled instance.

    Instances whose name is no class of the run are listed with a reason and not scored.
    """
    groups = joinings(recognizer.run.classifiers)
    classes = recognizer.run.classes
    run = Run("", "", recognizer)
    found: list[Instance] = []
    for item in frames:
        for answer in answer_frame([run], item):
            reason = answer.reason if answer.truth in classes else NO_CLASS
            answers: dict[str, tuple[str, float]] = {}
            if reason is None and answer.probabilities is not None:
                rows = dict(zip(recognizer.run.classifiers, answer.probabilities[:, None], strict=True))
                for name, group in groups.items():
                    index, confidence = join_by(DEFAULT_RULE, {feature: rows[feature] for feature in group})
                    answers[name] = classes[index[0]], float(confidence[0])
            attributes = dict(item.attributes)
            occluded = answer.occluded and bool(answers)
            found.append(Instance(item.identifier, answer.label, answer.truth, attributes, answers, occluded, reason))
        progress(item.identifier)
    return found


def summarize(instances: Sequence[Instance], names: Sequence[str]) -> dict[str, Any]:
    """Accuracy of each joining, over all scored instances and by every attribute's values.

    Instances without an answer count as wrong.
    """
    scored = [i for i in instances if i.reason != NO_CLASS]

    def accuracy(part: Sequence[Instance]) -> dict[str, Any]:
        right = {n: [i.answers.get(n, (None,))[0] == i.truth for i in part] for n in names}
        return {"instances": len(part), **{n: float(np.mean(v)) if v else None for n, v in right.items()}}

    table: dict[str, Any] = {"all": {"all": accuracy(scored)}}
    attributes = [i.attributes for i in scored]
    for attribute in sorted({key for each in attributes for key in each}):
        cells = parts(attributes, (attribute,))
        table[attribute] = {value: accuracy([scored[k] for k in rows]) for (value,), rows in cells.items()}
    return {
        "accuracy": table,
        "scored": len(scored),
        "unanswered": sum(not i.answers for i in scored),
        "not_scored": len(instances) - len(scored),
    }
