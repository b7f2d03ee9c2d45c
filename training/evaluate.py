"""Accuracy of a trained run on labelled frames (paper, "Results").

Every joining of classifiers, over all frames and by attribute.
"""

import dataclasses
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thor2_jax.classifier import FEATURES, Feature, join
from thor2_jax.files import write_text
from thor2_jax.recognizer import Recognizer
from training.readers.labelled import LabelledFrame

__all__ = ["Instance", "evaluate", "joinings", "summarize", "write_report"]


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


def joinings(available: Iterable[Feature]) -> dict[str, tuple[Feature, ...]]:
    """Every combination of the classifiers at hand, by the paper's names: CE, TOPS, ..., THOR2 (= TOPS + TOPS2)."""
    names = [name for name in FEATURES if name in set(available)]
    groups = [group for size in range(1, len(names) + 1) for group in itertools.combinations(names, size)]
    return {"THOR2" if group == ("tops", "tops2") else "+".join(group).upper(): group for group in groups}


def evaluate(
    recognizer: Recognizer, frames: Iterable[LabelledFrame], progress: Callable[[str], object] = lambda identifier: None
) -> list[Instance]:
    """Recognize every labelled instance.

    Instances whose name is no class of the run are listed with a reason and not scored.
    """
    groups = joinings(recognizer.run.classifiers)
    classes = recognizer.run.classes
    found: list[Instance] = []
    for item in frames:
        described = recognizer.describe(item.frame)
        probabilities = recognizer.probabilities(described.descriptors)
        joined = {name: join({f: probabilities[f] for f in group}) for name, group in groups.items()}
        rows = {described.clouds[index].label: row for row, index in enumerate(described.usable)}
        reasons = {cloud.label: cloud.reason for cloud in described.clouds}
        for label, truth in sorted(item.truth.items()):
            row = rows.get(label)
            base = Instance(item.identifier, label, truth, dict(item.attributes), {})
            if truth not in classes:
                base = dataclasses.replace(base, reason="no class of this run")
            elif row is None:
                base = dataclasses.replace(base, reason=reasons.get(label) or "no pixels in the label image")
            else:
                answers = {n: (classes[j.class_index[row]], float(j.confidence[row])) for n, j in joined.items()}
                base = dataclasses.replace(base, answers=answers, occluded=described.occluded[row])
            found.append(base)
        progress(item.identifier)
    return found


def summarize(instances: Sequence[Instance], names: Sequence[str]) -> dict[str, Any]:
    """Accuracy of each joining, over all scored instances and by every attribute's values.

    Instances without an answer count as wrong.
    """
    scored = [i for i in instances if i.reason != "no class of this run"]

    def accuracy(part: Sequence[Instance]) -> dict[str, Any]:
        right = {n: [i.answers.get(n, (None,))[0] == i.truth for i in part] for n in names}
        return {"instances": len(part), **{n: float(np.mean(v)) if v else None for n, v in right.items()}}

    table: dict[str, Any] = {"all": {"all": accuracy(scored)}}
    for attribute in sorted({key for i in scored for key in i.attributes}):
        values = sorted({i.attributes[attribute] for i in scored if attribute in i.attributes})
        table[attribute] = {v: accuracy([i for i in scored if i.attributes.get(attribute) == v]) for v in values}
    return {
        "accuracy": table,
        "scored": len(scored),
        "unanswered": sum(not i.answers for i in scored),
        "not_scored": len(instances) - len(scored),
    }


def write_report(path: str | Path, summary: Mapping[str, Any], instances: Sequence[Instance]) -> None:
    """Write the summary and every instance as one JSON file; it appears whole or not at all."""
    rows = [dataclasses.asdict(i) for i in instances]
    write_text(path, json.dumps({**summary, "instances": rows}, indent=1) + "\n")
