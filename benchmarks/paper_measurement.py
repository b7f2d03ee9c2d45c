"""Measurements of `benchmarks.paper`: accuracy by column, paired comparisons for the claims, recognition time.

A paired comparison is the difference of two methods' accuracies on the same instances, with a confidence interval. The
interval and the test use placements instead of instances, since neighbouring frames of a video are nearly equal. A
placement is an object that does not move. The interval is a bootstrap over placements, and McNemar's exact test counts
the placements on which one of the methods is better.
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from thor2_jax.files import json_digest
from thor2_jax.model.fusion import DEFAULT_RULE
from thor2_jax.model.inference import infer
from thor2_jax.recognizer import DescribedFrame
from training.baselines.baseline import BaselineInputs, Predictor
from training.baselines.image_baselines import ARCHITECTURES
from training.baselines.job import CLOUD_BASELINES, TITLES
from training.evaluation.answers import FrameAnswers, Rule, read_answers
from training.evaluation.job import ANSWERS, evaluate_dataset
from training.evaluation.results import compute_results, fuse_answers, split_known
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrames

__all__ = ["CLAIMS", "Dataset", "compare_runs", "paired_difference", "recognition_seconds"]

RULES: tuple[Rule, ...] = (DEFAULT_RULE, "max")
"""The project's fusion rule and the paper's."""

TIMED_FRAMES = 5


CLAIMS = {
    "THOR": "THOR2 above THOR",
    "TOPS": "colour helps: THOR2 above TOPS",
    "CE+TOPS+TOPS2": "THOR2 above CE + TOPS + TOPS2",
    **{TITLES[name]: f"THOR2 above {TITLES[name]}" for name in (*ARCHITECTURES, "forest", "pointnet")},
}
"""Column -> claim of the paper that THOR2 is more accurate; templates, forest and PointNet are not in the paper."""


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Frames that are evaluated together.

    Attributes:
        kind: kind of dataset, as for `evaluate_dataset`.
        parts: name -> frames.
    """

    kind: str
    parts: Mapping[str, LabelledFrames]


def compare_runs(dataset: Dataset, runs: Sequence[Run], directory: Path) -> dict[str, Any]:
    """Evaluate runs and return accuracies, published tables and claims; an interrupted evaluation resumes.

    Args:
        dataset: the frames.
        runs: the folds.
        directory: directory of the evaluations, each in a directory for its part and its choice of runs and baselines.
    """
    models = json_digest([run.digest for run in runs])[:8]
    frames: list[FrameAnswers] = []
    for name, part in dataset.parts.items():
        out = directory / f"evaluation-{name}-{models}"
        evaluate_dataset(runs, part, {"kind": dataset.kind, "path": name}, out)
        prefix = f"{name}/" if len(dataset.parts) > 1 else ""
        frames += [dataclasses.replace(each, frame=prefix + each.frame) for each in read_answers(out / ANSWERS)]
    report = compute_results(dataset.kind, runs, frames)
    return {
        "objects": len(report["classes"]),
        "frames": len(frames),
        **{name: report[name] for name in ("instances", "placements", "fusions", "main", "scratch")},
        "accuracy": {rule: report["accuracy"][rule] for rule in RULES},
        "by_part": _accuracy_by_part(dataset, runs, frames),
        "published_tables": report["published_tables"],
        "claims": {rule: claims(runs, frames, rule) for rule in RULES},
    }


def _accuracy_by_part(dataset: Dataset, runs: Sequence[Run], frames: Sequence[FrameAnswers]) -> dict[str, Any]:
    """Return part -> column -> accuracy with the default rule, as the mean over the folds."""
    values: dict[str, Any] = {}
    for name in dataset.parts if len(dataset.parts) > 1 else ():
        own = [frame for frame in frames if frame.frame.startswith(f"{name}/")]
        correct, placement = correct_answers(runs, own, DEFAULT_RULE)
        values[name] = {
            "instances": len(placement),
            "placements": len(np.unique(placement)),
            "accuracy": {title: float(np.mean(marks)) for title, marks in correct.items()} if len(placement) else {},
        }
    return values


def correct_answers(
    runs: Sequence[Run], frames: Sequence[FrameAnswers], rule: Rule
) -> tuple[dict[str, NDArray[np.bool_]], NDArray[np.intp]]:
    """Return column -> [F, N] whether each fold is correct on each known instance, and the placements [N]."""
    scored = split_known(frames, runs[0].classes)
    correct = {
        title: np.stack([predictions.class_index == scored.truth for predictions in by_run.values()])
        for title, by_run in fuse_answers(scored.known, runs, rule).items()
    }
    return correct, scored.placement


RESAMPLES = 9999
LEVEL = 0.95
SIGNIFICANCE = 0.05


@dataclasses.dataclass(frozen=True)
class PairedDifference:
    """The accuracy of one method minus the accuracy of another method.

    Attributes:
        difference: difference over the instances, as the mean over the folds.
        low: lower end of the 95 % interval.
        high: upper end of the 95 % interval.
        better: number of placements on which the first method is better, in the mean over the folds.
        worse: number of placements on which the first method is worse.
        p_value: p-value of McNemar's exact test, two-sided; 1 if no placement differs.
        instances: number of instances.
        placements: number of placements.
    """

    difference: float
    low: float
    high: float
    better: int
    worse: int
    p_value: float
    instances: int
    placements: int

    @property
    def verdict(self) -> str:
        """Return "holds" or "does not hold" if the whole interval is above or below 0 and the test agrees.

        Otherwise, return "undecided". The test is needed, since the interval is too narrow if a few placements all
        differ in the same way.
        """
        if self.p_value >= SIGNIFICANCE or self.low <= 0 <= self.high:
            return "undecided"
        return "holds" if self.low > 0 else "does not hold"


def _ratio(total: NDArray[Any], count: NDArray[Any], axis: int = -1) -> NDArray[Any]:
    return np.asarray(total.sum(axis=axis) / count.sum(axis=axis))


def paired_difference(
    first: NDArray[Any], second: NDArray[Any], placement: NDArray[np.integer[Any]], seed: int = 0
) -> PairedDifference:
    """Compare two methods on the same instances.

    Args:
        first: [F, N], whether the first method is correct on each of N instances, for each of F folds.
        second: [F, N], whether the second method is correct.
        placement: [N] int, the placement of each instance; at least one instance.
        seed: seed for the bootstrap.
    """
    difference = np.mean(first, axis=0) - np.mean(second, axis=0)
    numbers = np.unique(placement, return_inverse=True)[1].ravel()
    total, count = np.bincount(numbers, difference), np.bincount(numbers).astype(float)
    low = high = float(difference.mean())
    if np.ptp(total / count) > 0:
        interval = stats.bootstrap(
            (total, count), _ratio, paired=True, vectorized=True, n_resamples=RESAMPLES, confidence_level=LEVEL,
            method="percentile", rng=np.random.default_rng(seed),
        ).confidence_interval  # fmt: skip
        low, high = float(interval.low), float(interval.high)
    # Means over folds are sums of multiples of 1/F, so smaller differences are rounding errors.
    better, worse = int((total > 1e-9).sum()), int((total < -1e-9).sum())
    p_value = float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0
    return PairedDifference(float(difference.mean()), low, high, better, worse, p_value, len(difference), len(count))


def claims(runs: Sequence[Run], frames: Sequence[FrameAnswers], rule: Rule) -> list[dict[str, Any]]:
    """Return the paired comparisons of THOR2 with the other columns."""
    correct, placement = correct_answers(runs, frames, rule)
    found = []
    for other, claim in CLAIMS.items():
        if "THOR2" in correct and other in correct:
            difference = paired_difference(correct["THOR2"], correct[other], placement)
            found.append(
                {"claim": claim, "other": other, **dataclasses.asdict(difference), "verdict": difference.verdict}
            )
    return found


def recognition_seconds(run: Run, dataset: Dataset) -> dict[str, float]:
    """Return method -> seconds per instance, from the frame in memory to the probabilities, after compilation.

    Methods on clouds segment and describe the frame; image networks crop it.
    """
    part = next(iter(dataset.parts.values()))
    frames = [part[number].frame for number in range(min(TIMED_FRAMES, len(part)))]
    recognizer, config = run.recognizer, run.recognizer.run.config
    described = [recognizer.describe(frame) for frame in frames]
    n_instances = sum(len(each.usable) for each in described)

    def timed(function: Callable[[int], object]) -> float:
        for number in range(len(frames)):
            function(number)  # compiles
        start = time.perf_counter()
        for number in range(len(frames)):
            function(number)
        return (time.perf_counter() - start) / max(n_instances, 1)

    def classify(frame: DescribedFrame) -> object:
        names = tuple(run.model.classifiers)
        return jax.block_until_ready(infer(run.model, frame.oriented, classifiers=names).probabilities)

    describing = timed(lambda number: recognizer.describe(frames[number]))
    seconds = {"THOR2": describing + timed(lambda number: classify(described[number]))}
    for name, baseline in run.baselines.items():

        def recognize(number: int, predict: Predictor = baseline.predict) -> object:
            return predict(BaselineInputs.of_frame(described[number], config, frames[number]))

        seconds[name] = timed(recognize) + (describing if name in CLOUD_BASELINES else 0)
    return seconds
