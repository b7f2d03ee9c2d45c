"""From the answers to every figure of a report, as one table that JSON holds."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.fusion import DEFAULT_RULE
from training.evaluation.accuracy import over_runs, parts, tables_of
from training.evaluation.answers import FrameAnswers, InstanceAnswer
from training.evaluation.confidence import accuracy_at_coverage, auroc, expected_calibration_error, reliability
from training.evaluation.fusion import RULES, Rule, join_by, joinings, main_joining
from training.evaluation.published import published
from training.readers.labelled import sequence_of

__all__ = ["COVERAGE", "Answered", "answered", "results", "wrong_answers"]

COVERAGE = 0.95
"""Share of the answers that is kept where the least confident are called unknown."""

Columns = Sequence[tuple[int, str]]

Temperatures = Sequence[Mapping[str, float]]
"""A table a run: classifier or baseline -> temperature. Those that were not calibrated are not in it."""


@dataclasses.dataclass(frozen=True, eq=False)
class Answered:
    """The answers of one run's joining to the instances that were described.

    Attributes:
        answer: [N] class indices.
        confidence: [N].
    """

    answer: NDArray[np.intp]
    confidence: NDArray[np.floating[Any]]


def answered(
    instances: Sequence[InstanceAnswer], columns: Columns, rule: Rule = DEFAULT_RULE, temperatures: Temperatures = ()
) -> dict[str, dict[int, Answered]]:
    """Joining -> run -> answers to those of `instances` that were described.

    The rule "calibrated" leaves out what lacks a temperature.
    """
    described = [i.probabilities for i in instances if i.probabilities is not None]
    table = np.stack(described) if described else np.zeros((0, len(columns), 1), np.float32)  # [N, M, C]
    found: dict[str, dict[int, Answered]] = {title: {} for title in joinings(name for _, name in columns)}
    for run in sorted({run for run, _ in columns}):
        known = temperatures[run] if rule == "calibrated" else {}
        mine = {
            name: table[:, k]
            for k, (r, name) in enumerate(columns)
            if r == run and (rule != "calibrated" or name in known)
        }
        for title, group in joinings(mine).items():
            found[title][run] = Answered(*join_by(rule, {name: mine[name] for name in group}, known))
    return {title: by_run for title, by_run in found.items() if by_run}


def wrong_answers(
    frame: FrameAnswers, columns: Columns, classes: Sequence[str]
) -> Iterable[tuple[InstanceAnswer, str, float]]:
    """Instance, answer and confidence of every wrong answer of the main joining of any run, where there was a right."""
    described = [i for i in frame.instances if i.probabilities is not None and i.truth in classes]
    found = answered(described, columns)
    for given in found[main_joining(found)].values():
        for instance, answer, confidence in zip(described, given.answer, given.confidence, strict=True):
            if classes[answer] != instance.truth:
                yield instance, classes[answer], float(confidence)


def _attributes(kind: str, frame: FrameAnswers) -> dict[str, str]:
    # OCID's tables go by sequence: the folder of the frame.
    sequence = {"sequence": sequence_of(frame.frame)} if kind == "ocid" else {}
    return {**frame.attributes, **sequence}


def results(
    kind: str,
    frames: Sequence[FrameAnswers],
    columns: Columns,
    runs: Sequence[str],
    classes: Sequence[str],
    temperatures: Temperatures,
) -> dict[str, Any]:
    """Every figure.

    An instance that is a class of the runs is scored; one that could not be described counts as wrong. What is told of
    confidence concerns the instances that were described.

    Args:
        kind: of the dataset: "uwis", "ocid", "bop", "frames".
        frames: their answers.
        columns: of the answers.
        runs: names.
        classes: names, in the order of the probabilities.
        temperatures: of the runs.
    """
    labelled = [(i, _attributes(kind, frame)) for frame in frames for i in frame.instances]
    scored = [(i, attributes) for i, attributes in labelled if i.truth in classes]
    described = [i for i, _ in scored if i.probabilities is not None]
    strangers = [i for i, _ in labelled if i.truth not in classes and i.probabilities is not None]
    position = np.array([n for n, (i, _) in enumerate(scored) if i.probabilities is not None], np.intp)
    truth = np.array([classes.index(i.truth) for i in described], np.intp)
    seconds = [frame.seconds for frame in frames]
    found: dict[str, Any] = {
        "runs": list(runs),
        "classes": list(classes),
        "rule": DEFAULT_RULE,
        "instances": {
            "labelled": len(labelled),
            "scored": len(scored),
            "not_described": dict(Counter(i.reason for i, _ in scored if i.probabilities is None)),
            "no_class": dict(Counter(i.truth for i, _ in labelled if i.truth not in classes)),
        },
        "speed": {
            "frames": len(frames),
            "seconds": sum(seconds),
            "frames_per_second": len(frames) / sum(seconds) if sum(seconds) else None,
            "median_seconds": float(np.median(seconds)) if seconds else None,
        },
        "joinings": [],
    }
    if not scored:
        return found
    by_rule = {rule: answered(described, columns, rule, temperatures) for rule in RULES}
    found["joinings"] = list(by_rule[DEFAULT_RULE])
    tables = tables_of(kind, [attributes for _, attributes in scored])
    found["accuracy"] = {
        rule: [_table(kind, names, scored, position, truth, given) for names in tables]
        for rule, given in by_rule.items()
    }
    given = by_rule[DEFAULT_RULE]
    found["temperatures"] = {
        name: dataclasses.asdict(over_runs([known[name] for known in temperatures if name in known]))
        for name in dict.fromkeys(name for _, name in columns)
    }
    rules: dict[str, Rule] = {"confidence": DEFAULT_RULE, "calibrated_confidence": "calibrated"}
    for key, rule in rules.items():
        unknown = answered(strangers, columns, rule, temperatures)
        found[key] = {name: _confidence(by_run, truth, unknown[name]) for name, by_run in by_rule[rule].items()}
    found["main"] = main = main_joining(given)
    confidence = np.concatenate([a.confidence for a in given[main].values()])
    right = np.concatenate([a.answer == truth for a in given[main].values()])
    bins = reliability(np.minimum(confidence, 1), right)
    found["reliability"] = {
        "answers": bins.answers.tolist(),
        "accuracy": [None if np.isnan(v) else float(v) for v in bins.accuracy],
        "confidence": [None if np.isnan(v) else float(v) for v in bins.confidence],
    }
    missed = Counter(i.truth for i, _ in scored if i.probabilities is None)
    found["confusion"] = _confusion(given[main], truth, [missed[name] for name in classes]).tolist()
    return found


def _table(
    kind: str,
    names: Sequence[str],
    scored: Sequence[tuple[InstanceAnswer, Mapping[str, str]]],
    position: NDArray[np.intp],
    truth: NDArray[np.intp],
    given: Mapping[str, Mapping[int, Answered]],
) -> dict[str, Any]:
    """Accuracy of each joining in each cell; those of publications beside it."""
    right: dict[str, list[NDArray[np.bool_]]] = {name: [] for name in given}
    for name, by_run in given.items():
        for a in by_run.values():
            marks = np.zeros(len(scored), bool)
            marks[position] = a.answer == truth
            right[name].append(marks)
    known = published(kind)
    cells = []
    for values, rows in parts([attributes for _, attributes in scored], names).items():
        where = dict(zip(names, values, strict=True))
        accuracy = {n: dataclasses.asdict(over_runs([m[rows].mean() for m in marks])) for n, marks in right.items()}
        others = known.of(where) if known else {}
        cells.append({"where": where, "instances": len(rows), "accuracy": accuracy, "published": others})
    return {"by": list(names), "cells": cells}


def _confidence(by_run: Mapping[int, Answered], truth: NDArray[np.intp], unknown: Mapping[int, Answered]) -> Any:
    """Of a joining: how far to trust it on objects of the training, and on others (`unknown`)."""
    rows: dict[str, list[float]] = {
        "expected_calibration_error": [],
        "auroc_right": [],
        "threshold_at_coverage": [],
        "accuracy_at_coverage": [],
        "auroc_known": [],
        "unknown_refused": [],
    }
    for run, a in by_run.items():
        confidence, right = np.minimum(a.confidence, 1), a.answer == truth
        kept = accuracy_at_coverage(confidence, right, COVERAGE)
        rows["expected_calibration_error"].append(expected_calibration_error(confidence, right))
        rows["auroc_right"].append(auroc(confidence, right))
        rows["threshold_at_coverage"].append(kept.threshold)
        rows["accuracy_at_coverage"].append(kept.accuracy)
        strange = np.minimum(unknown[run].confidence, 1)
        if len(strange):
            rows["unknown_refused"].append(float((strange < kept.threshold).mean()))
            everything = np.concatenate([confidence, strange])
            rows["auroc_known"].append(auroc(everything, np.arange(len(everything)) < len(confidence)))
    return {name: dataclasses.asdict(over_runs(values)) for name, values in rows.items()}


def _confusion(by_run: Mapping[int, Answered], truth: NDArray[np.intp], missed: Sequence[int]) -> NDArray[np.intp]:
    """[C, C + 1] counts over all runs: rows the truth, columns the answers, the last one those not described."""
    counts = np.zeros((len(missed), len(missed) + 1), np.intp)
    for a in by_run.values():
        np.add.at(counts, (truth, a.answer), 1)
    counts[:, -1] = np.array(missed) * len(by_run)
    return counts
