"""Computation of all values of a report from the answers, as one JSON table."""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.model.fusion import DEFAULT_RULE
from thor2_jax.printable import find_name, first_names
from training.evaluation import scores
from training.evaluation.answers import RULES, FrameAnswers, InstancePrediction, Predictions, Rule, fusions, main_fusion
from training.evaluation.published import compare_with_published
from training.evaluation.runs import Run, all_predictors, scratch_networks
from training.evaluation.scores import Flags, Floats, summarize_rows, summarize_runs
from training.readers.labelled import sequence_of

__all__ = [
    "KnownAndUnknown",
    "check_known",
    "compute_results",
    "confidence_metrics",
    "fuse_answers",
    "judged_confidences",
    "named_answers",
    "split_known",
]

CURVE = tuple(k / 100 for k in range(101))
"""Fractions of the correct answers at which the known/unknown curve is computed."""

Integers = NDArray[np.intp]

MOST_FREQUENT = 12
"""Number of confusions (object and wrong name) that a report lists, for known and for unknown objects."""


Fused = Mapping[str, Mapping[int, Predictions]]
"""Fusion -> index of the run -> predictions."""


def fuse_answers(
    instances: Sequence[InstancePrediction], runs: Sequence[Run], rule: Rule = DEFAULT_RULE
) -> dict[str, dict[int, Predictions]]:
    """Return fusion -> index of the run -> predictions for the instances.

    The rule "calibrated" leaves out classifiers without a temperature.
    """
    predictors = all_predictors(runs)
    described = np.array([i.probabilities is not None for i in instances], bool)
    tables = [i.probabilities for i in instances if i.probabilities is not None]
    table = np.stack(tables) if tables else np.zeros((0, len(predictors), 1), np.float32)  # [described, M, C]
    predictions: dict[str, dict[int, Predictions]] = {title: {} for title in fusions(name for _, name in predictors)}
    for index, run in enumerate(runs):
        probabilities = {
            name: table[:, column]
            for column, (owner, name) in enumerate(predictors)
            if owner == index and (rule != "calibrated" or name in run.temperatures)
        }
        for title, names in fusions(probabilities).items():
            fused = Predictions.fused(rule, {name: probabilities[name] for name in names}, run.temperatures)
            answer = Predictions(np.full(len(instances), -1), np.zeros(len(instances), fused.confidence.dtype))
            answer.class_index[described], answer.confidence[described] = fused
            predictions[title][index] = answer
    return {title: by_run for title, by_run in predictions.items() if by_run}


class KnownAndUnknown(NamedTuple):
    """The labelled instances of an evaluation: those of a class of the runs are known objects, the others unknown.

    Attributes:
        known: N instances of known objects.
        frames: [N] their frames.
        truth: [N] their classes.
        placement: [N] their placements, see `find_placements`.
        unknown: instances of unknown objects.
    """

    known: list[InstancePrediction]
    frames: list[FrameAnswers]
    truth: Integers
    placement: Integers
    unknown: list[InstancePrediction]

    def fuse_unknown(self, runs: Sequence[Run], rule: Rule) -> Fused:
        """Return the fused predictions for the unknown objects that could be described."""
        return fuse_answers([each for each in self.unknown if each.probabilities is not None], runs, rule)


def split_known(
    frames: Sequence[FrameAnswers], classes: Sequence[str], placement: Integers | None = None
) -> KnownAndUnknown:
    """Separate the instances of known objects from those of unknown objects.

    Args:
        frames: the answers.
        classes: names of the known objects.
        placement: placement of every instance; by default those of `find_placements`.
    """
    if placement is None:
        placement = np.concatenate([np.zeros(0, np.intp), *scores.find_placements(frames)])
    labelled = [(instance, frame) for frame in frames for instance in frame.instances]
    is_known = np.array([instance.truth in classes for instance, _ in labelled], bool)
    known = list(itertools.compress(labelled, is_known))
    truth = np.array([classes.index(instance.truth) for instance, _ in known], np.intp)
    unknown = [instance for instance, _ in itertools.compress(labelled, ~is_known)]
    return KnownAndUnknown([i for i, _ in known], [frame for _, frame in known], truth, placement[is_known], unknown)


def named_answers(
    instances: Sequence[InstancePrediction], runs: Sequence[Run]
) -> Iterator[tuple[int, InstancePrediction, str | None, float]]:
    """Yield the answers of `recognize` with each run: index of the run, described instance, name or None, confidence.

    The name is None if the confidence is below the run's threshold, which means that the object is unknown.
    """
    predictions = fuse_answers(instances, runs)
    for run, answers in predictions[main_fusion(predictions, runs[0].answer_by)].items():
        thresholds = runs[run].thresholds
        for instance, index, confidence in zip(instances, *answers, strict=True):
            if index >= 0:
                name = runs[run].classes[index] if confidence >= thresholds[index] else None
                yield run, instance, name, float(confidence)


def compute_results(kind: str, runs: Sequence[Run], frames: Sequence[FrameAnswers]) -> dict[str, Any]:
    """Return accuracy, confidence metrics, confusions and speed.

    Args:
        kind: kind of dataset ("uwis", "ocid", "bop", "frames"); selects the tables and the published values.
        runs: evaluated runs, which share their classes.
        frames: the answers.

    Raises:
        InputError: no instance is of a class of the runs.
    """
    classes = runs[0].classes
    scored = split_known(frames, classes)
    truth, placement = scored.truth, scored.placement
    check_known({instance.truth for frame in frames for instance in frame.instances}, classes)
    seconds = [frame.seconds for frame in frames]
    # One table of OCID is by sequence, which is the directory of the frame.
    attributes = [
        {**frame.attributes, **({"sequence": sequence_of(frame.frame)} if kind == "ocid" else {})}
        for frame in scored.frames
    ]
    by_rule = {rule: fuse_answers(scored.known, runs, rule) for rule in RULES}
    unknown = scored.fuse_unknown(runs, DEFAULT_RULE)
    tables = scores.attribute_tables(kind, attributes)
    main = main_fusion(by_rule[DEFAULT_RULE], runs[0].answer_by)
    by_run, unknown_by_run = by_rule[DEFAULT_RULE][main], unknown[main]
    correct = {
        rule: {title: [p.class_index == truth for p in of_runs.values()] for title, of_runs in known.items()}
        for rule, known in by_rule.items()
    }
    rejection = [_rejection(by_run[run], truth, unknown_by_run[run], runs[run].thresholds) for run in by_run]
    # Rows are true classes. The last column counts instances that are not described, since their index is -1.
    confusion = np.zeros((len(classes), len(classes) + 1), np.intp)
    for predictions in by_run.values():
        np.add.at(confusion, (truth, predictions.class_index), 1)

    def of_runs(measure: Callable[[Predictions], float]) -> dict[str, Any]:
        return {title: summarize_runs([*map(measure, each.values())]) for title, each in by_rule[DEFAULT_RULE].items()}

    counts, worst = _answers([*scored.known, *scored.unknown], runs)
    return {
        "runs": [run.name for run in runs],
        "classes": list(classes),
        "rule": DEFAULT_RULE,
        "instances": {
            "labelled": len(scored.known) + len(scored.unknown),
            "scored": len(scored.known),
            "not_described": dict(Counter(i.reason for i in scored.known if i.probabilities is None)),
            "no_class": dict(Counter(i.truth for i in scored.unknown)),
        },
        "speed": {
            "frames": len(seconds),
            "seconds": sum(seconds),
            "frames_per_second": len(seconds) / sum(seconds),
            "median_seconds": float(np.median(seconds)),
        },
        "fusions": list(by_rule[DEFAULT_RULE]),
        "worst": worst,
        "published_tables": compare_with_published(
            kind, runs, len(frames), attributes, [i.truth for i in scored.known], correct[DEFAULT_RULE]
        ),
        "scratch": scratch_networks(runs),
        "accuracy": {
            rule: [_accuracy(names, attributes, by_title) for names in tables] for rule, by_title in correct.items()
        },
        "temperatures": {
            name: summarize_runs([run.temperatures[name] for run in runs if name in run.temperatures])
            for name in dict.fromkeys(name for _, name in all_predictors(runs))
        },
        "confidence": _confidence(by_rule[DEFAULT_RULE], unknown, truth),
        "calibrated_confidence": _confidence(by_rule["calibrated"], scored.fuse_unknown(runs, "calibrated"), truth),
        "placements": {
            "count": len(np.unique(placement)),
            "accuracy": of_runs(lambda each: scores.placement_accuracy(placement, each.class_index == truth)),
            "steadiness": of_runs(lambda each: scores.steadiness(placement, each.class_index)),
        },
        "main": main,
        "rejection": summarize_rows(rejection),
        "known_unknown": _known_unknown([(by_run[run], unknown_by_run[run]) for run in by_run], truth),
        "reliability": _reliability(list(by_run.values()), truth),
        "confusion": confusion.tolist(),
        "answers": counts,
    }


def check_known(names: Iterable[str], classes: Sequence[str]) -> None:
    """Raise InputError unless an object of a dataset is of a class of the runs; read names until there is one."""
    unknown: set[str] = set()
    for name in names:
        if name not in unknown and find_name(name, classes):
            return
        unknown.add(name)
    raise InputError(
        f"model: no object of the dataset is of a class of the runs; it has {first_names(sorted(unknown)) or 'none'}, "
        f"the runs have {first_names(sorted(classes))}; check the names, give other runs, or frames with known objects"
    )


def _accuracy(
    names: Sequence[str], attributes: Sequence[Mapping[str, str]], correct: Mapping[str, Sequence[Flags]]
) -> dict[str, Any]:
    """Return the accuracy of each fusion by the named attributes."""
    cells = []
    for values, rows in scores.group_by_attributes(attributes, names).items():
        accuracy = {title: summarize_runs([marks[rows].mean() for marks in each]) for title, each in correct.items()}
        cells.append({"where": dict(zip(names, values, strict=True)), "instances": len(rows), "accuracy": accuracy})
    return {"by": list(names), "cells": cells}


def _confidence(fused: Fused, unknown: Fused, truth: Integers) -> dict[str, Any]:
    """Return confidence metrics of each fusion, for known objects and for known against unknown objects."""
    return {
        title: summarize_rows([confidence_metrics(by_run[run], truth, unknown[title][run]) for run in by_run])
        for title, by_run in fused.items()
    }


def judged_confidences(known: Predictions, truth: Integers) -> tuple[Floats, Flags]:
    """Return the confidences of the described instances, at most 1, and whether their answers are correct."""
    described = known.described
    return np.minimum(known.confidence[described], 1), (known.class_index == truth)[described]


def confidence_metrics(known: Predictions, truth: Integers, unknown: Predictions) -> dict[str, float]:
    """Return the confidence metrics of a run: see `scores`; "unknown_refused" is at the `COVERAGE` of all answers.

    Args:
        known: predictions for N known objects.
        truth: [N] their classes.
        unknown: predictions for unknown objects that could be described.
    """
    confidence, correct = judged_confidences(known, truth)
    of_unknown = np.minimum(unknown.confidence, 1)
    threshold, accuracy = scores.accuracy_at_coverage(confidence, correct)
    every = np.concatenate([confidence, of_unknown])
    return {
        "expected_calibration_error": scores.expected_calibration_error(confidence, correct),
        "auroc_right": scores.auroc(confidence, correct),
        "threshold_at_coverage": threshold,
        "accuracy_at_coverage": accuracy,
        "auroc_known": scores.auroc(every, np.arange(len(every)) < len(confidence)),
        "unknown_refused": float((of_unknown < threshold).mean()) if len(of_unknown) else np.nan,
        "unknown_named": float(scores.unknown_named(confidence[correct], of_unknown)),
    }


def _rejection(
    known: Predictions, truth: Integers, unknown: Predictions, thresholds: NDArray[np.float64]
) -> dict[str, float]:
    """Return fractions of the known and the unknown objects without rejection and at the run's thresholds [C]."""
    correct = known.class_index == truth
    named = known.described & (known.confidence >= thresholds[known.class_index])
    return {
        "threshold": float(np.median(thresholds)) or np.nan,
        "accuracy": float(correct.mean()),
        "incorrect": float((known.described & ~correct).mean()),
        "accuracy_at_threshold": float((correct & named).mean()),
        "incorrect_at_threshold": float((named & ~correct).mean()),
        "unknown_named_at_threshold": float((unknown.confidence >= thresholds[unknown.class_index]).mean())
        if len(unknown.confidence)
        else np.nan,
    }


def _known_unknown(
    predictions: Sequence[tuple[Predictions, Predictions]], truth: Integers
) -> dict[str, list[float]] | None:
    """Return the known/unknown curve as the mean over the runs; None without unknown objects or correct answers.

    Args:
        predictions: predictions for known and for unknown objects of each run.
        truth: [N] classes of the known objects.
    """
    correct = [(known.confidence[known.class_index == truth], unknown) for known, unknown in predictions]
    named = np.array([scores.unknown_named(confidence, unknown.confidence, CURVE) for confidence, unknown in correct])
    named = named[np.isfinite(named).all(axis=1)]
    return {"kept": list(CURVE), "named": named.mean(axis=0).tolist()} if len(named) else None


def _reliability(predictions: Sequence[Predictions], truth: Integers) -> dict[str, list[Any]]:
    """Return the bins of the reliability diagram, all runs together."""
    confidence, correct = zip(*(judged_confidences(each, truth) for each in predictions), strict=True)
    bins = scores.reliability(np.concatenate(confidence), np.concatenate(correct))
    return {name: [None if np.isnan(value) else value for value in values.tolist()] for name, values in bins.items()}


def _answers(
    instances: Sequence[InstancePrediction], runs: Sequence[Run]
) -> tuple[dict[str, int], list[dict[str, Any]]]:
    """Return counts of answers over all runs, and the most frequent wrong names, those of unknown objects first."""
    classes, count, wrong = runs[0].classes, Counter[str](), Counter[tuple[str, str]]()
    for _, instance, name, _ in named_answers(instances, runs):
        count["correct"] += name == instance.truth
        if name not in (None, instance.truth):
            count["wrong" if instance.truth in classes else "unknown_named"] += 1
            wrong[instance.truth, str(name)] += 1
    total = Counter(instance.truth for instance in instances for _ in runs)
    known = sum(n for truth, n in total.items() if truth in classes)
    worst = [
        {"truth": truth, "answer": name, "count": n, "share": n / total[truth], "known": truth in classes}
        for (truth, name), n in wrong.most_common()
    ]
    of_unknown, of_known = ([pair for pair in worst if pair["known"] is of_class] for of_class in (False, True))
    counts = {"known": known, "unknown": total.total() - known}
    counts |= {key: count[key] for key in ("correct", "wrong", "unknown_named")}
    return counts, of_unknown[:MOST_FREQUENT] + of_known[:MOST_FREQUENT]
