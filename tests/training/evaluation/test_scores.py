"""Scores and placements against values computed by hand."""

import math

import numpy as np
import pytest
from helpers import assert_refused

from training.evaluation import scores
from training.evaluation.answers import FrameAnswers, InstancePrediction


def test_calibration_error_matches_hand_calculation() -> None:
    """Two answers in bin 7 of 15 (0.4667 to 0.5333), three in the last, one in the first."""
    confidence = [0.5, 0.52, 0.95, 0.97, 1.0, 0.0]
    correct = [True, False, True, True, False, False]
    result = scores.reliability(confidence, correct)
    assert result.answers.tolist() == [1] + [0] * 6 + [2] + [0] * 6 + [3]
    assert result.accuracy[[0, 7, 14]] == pytest.approx([0, 1 / 2, 2 / 3])
    assert result.confidence[[0, 7, 14]] == pytest.approx([0, 0.51, 2.92 / 3])
    assert np.isnan(result.accuracy[1])
    by_hand = (1 * 0 + 2 * abs(0.5 - 0.51) + 3 * abs(2 / 3 - 2.92 / 3)) / 6
    assert scores.expected_calibration_error(confidence, correct) == pytest.approx(by_hand)
    # Bins include their upper edge.
    assert scores.reliability([0.5, 0.5000001, 1.0], [True] * 3, bins=2).answers.tolist() == [1, 2]


def test_metrics_without_answers_are_nan() -> None:
    error, area = scores.expected_calibration_error([], []), scores.auroc([0.1, 0.2], [True, True])
    unknown = [scores.unknown_named([], [0.5]), *scores.unknown_named([0.5], [], [0.1, 0.2])]
    assert np.isnan([error, area, *scores.accuracy_at_coverage([], []), *unknown]).all()


def test_auroc_is_the_fraction_of_ordered_pairs() -> None:
    rng = np.random.default_rng(2)
    confidence, positive = rng.integers(0, 6, 40) / 5, rng.random(40) < 0.4
    pairs = [(0.5 if p == n else float(p > n)) for p in confidence[positive] for n in confidence[~positive]]
    assert scores.auroc(confidence, positive) == pytest.approx(np.mean(pairs))


def test_coverage_matches_hand_calculation() -> None:
    confidence = np.arange(1, 21) / 20
    correct = np.ones(20, bool)
    correct[[0, 5]] = False
    result = scores.accuracy_at_coverage(confidence, correct)
    assert (result.threshold, result.kept, result.accuracy) == pytest.approx((0.1, 0.95, 18 / 19))
    assert scores.accuracy_at_coverage(confidence, correct, 1.0).accuracy == pytest.approx(0.9)
    tied = scores.accuracy_at_coverage([0.5, 0.5, 0.9], [False, True, True], 0.5)
    assert (tied.threshold, tied.kept) == (0.5, 1.0)


def test_invalid_arguments_are_refused() -> None:
    assert_refused(r"shapes \(2,\) and \(1,\)", scores.reliability, [0.1, 0.2], [True])
    assert_refused(r"1\.5", scores.auroc, [1.5, 0.2], [True, False])
    assert_refused("coverage is 0", scores.accuracy_at_coverage, [0.5], [True], 0)
    assert_refused("kept", scores.unknown_named, [0.5], [0.5], 1.5)


def test_unknown_named_matches_a_search_of_thresholds() -> None:
    """The oracle tries every threshold and takes the largest one that keeps enough."""
    rng = np.random.default_rng(3)
    correct, unknown = rng.integers(0, 12, 20) / 11, rng.integers(0, 12, 15) / 11
    kept = np.array([0.05, 0.5, 0.95, 1.0])
    by_search = []
    for share in kept:
        enough = [t for t in np.unique(correct) if (correct >= t).sum() >= share * len(correct) - 1e-9]
        by_search.append(np.mean(unknown >= max(enough)))
    assert scores.unknown_named(correct, unknown, kept).tolist() == pytest.approx(by_search)
    assert scores.unknown_named([0.9, 0.8, 0.7], [0.95, 0.75, 0.1], 2 / 3) == pytest.approx(1 / 3)
    assert scores.unknown_named([0.5], [0.9], 0.0) == 0


Objects = dict[int, tuple[str, tuple[float, float, float] | None]]


def video(frames: list[Objects], sequence: str = "a") -> list[FrameAnswers]:
    """Return frames of label -> name and position."""
    answers = []
    for k, objects in enumerate(frames):
        instances = [InstancePrediction(label, name, position=place) for label, (name, place) in objects.items()]
        answers.append(FrameAnswers(f"{sequence}/{k}", {}, 1.0, instances))
    return answers


def numbers(frames: list[FrameAnswers]) -> list[list[int]]:
    return [own.tolist() for own in scores.find_placements(frames)]


def test_an_unmoved_object_is_one_placement() -> None:
    """The camera moves by 2 cm a frame; the position of the first frame does not matter in the third."""
    still: list[Objects] = [{1: ("mug", (0.02 * k, 0, 1)), 2: ("can", (0.3, 0.02 * k, 1))} for k in range(3)]
    assert numbers(video(still)) == [[0, 1]] * 3
    assert numbers(video(still[:2]) + video(still[2:], "b")) == [[0, 1], [0, 1], [2, 3]]
    assert numbers([]) == []
    # Objects of one name are matched by position, the nearer pair first; here the labels are exchanged.
    one: Objects = {1: ("orange", (0, 0, 1)), 2: ("orange", (0.02, 0, 1))}
    other: Objects = {1: ("orange", (0.021, 0, 1)), 2: ("orange", (0.001, 0, 1))}
    assert numbers(video([one, other])) == [[0, 1], [1, 0]]


FOUR: Objects = {k: (f"object {k}", (0.1 * k, 0, 1)) for k in range(4)}


def test_moved_renamed_and_new_objects_have_new_placements() -> None:
    """With two of four objects moved, the others were put back near their place."""
    for changes, expected in (
        ({}, [0, 1, 2, 3]),
        ({3: ("object 3", (0.3, 0.029, 1))}, [0, 1, 2, 3]),
        ({3: ("object 3", (0.3, 0.031, 1))}, [0, 1, 2, 4]),
        ({0: ("object 0", None)}, [4, 1, 2, 3]),
        ({0: ("new", (0, 0, 1))}, [4, 1, 2, 3]),
        ({k: (f"object {k}", (0.1 * k, 0.2, 1)) for k in (2, 3)}, [4, 5, 6, 7]),
    ):
        assert numbers(video([FOUR, FOUR | changes])) == [[0, 1, 2, 3], expected]


def test_accuracy_and_steadiness_by_hand() -> None:
    """Placement 7 has one of four correct, 9 is all correct; its two answers of three agree, so do three of four."""
    placement, correct = [7, 9, 7, 9, 7, 9, 7, 4], [1, 1, 0, 1, 0, 1, 0, 0]
    assert scores.placement_accuracy(placement, correct) == pytest.approx((0.25 + 1 + 0) / 3)
    answers = [3, 0, 2, 0, 2, 1, 2, 5]
    assert scores.steadiness(placement, answers) == pytest.approx((3 + 2) / (4 + 3))
    assert math.isnan(scores.steadiness([1, 2], [0, 0])) and math.isnan(scores.steadiness([], []))
    assert math.isnan(scores.placement_accuracy([], []))
