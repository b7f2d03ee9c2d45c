"""Scores and placements against values computed by hand."""

import numpy as np
import pytest

from training.evaluation import scores
from training.evaluation.answers import FrameAnswers, InstancePrediction


def test_calibration_error_matches_hand_calculation() -> None:
    """Two answers in bin 7 of 15 (0.4667 to 0.5333), three in the last, one in the first."""
    confidence = np.array([0.5, 0.52, 0.95, 0.97, 1.0, 0.0])
    correct = np.array([True, False, True, True, False, False])
    result = scores.reliability(confidence, correct)
    assert result["answers"].tolist() == [1] + [0] * 6 + [2] + [0] * 6 + [3]
    assert result["accuracy"][[0, 7, 14]] == pytest.approx([0, 1 / 2, 2 / 3])
    assert result["confidence"][[0, 7, 14]] == pytest.approx([0, 0.51, 2.92 / 3])
    assert np.isnan(result["accuracy"][1])
    by_hand = (1 * 0 + 2 * abs(0.5 - 0.51) + 3 * abs(2 / 3 - 2.92 / 3)) / 6
    assert scores.expected_calibration_error(confidence, correct) == pytest.approx(by_hand)
    # Bins include their upper edge.
    assert np.flatnonzero(scores.reliability(np.array([0.2, 0.2000001]), correct[:2])["answers"]).tolist() == [2, 3]


def test_metrics_without_answers_are_nan() -> None:
    nothing, one = np.zeros(0), np.array([0.5])
    error, area = scores.expected_calibration_error(nothing, nothing), scores.auroc(one, one > 0)
    unknown = [scores.unknown_named(nothing, one), *scores.unknown_named(one, nothing, [0.1, 0.2])]
    assert np.isnan([error, area, *scores.accuracy_at_coverage(nothing, nothing), *unknown]).all()


def test_unknown_named_matches_a_search_of_thresholds() -> None:
    """The oracle tries every threshold and takes the largest one that keeps enough."""
    rng = np.random.default_rng(3)
    correct, unknown = rng.integers(0, 30, 25) / 29, rng.integers(0, 30, 90) / 29
    kept = np.array([0.05, 0.28, 0.56, 0.95, 1.0])  # 0.28 * 25 is more than 7 in floating point
    thresholds = [max(t for t in correct if (correct >= t).mean() >= share - 1e-9) for share in kept]
    by_search = [np.mean(unknown >= t) for t in thresholds]
    assert scores.unknown_named(correct, unknown, kept).tolist() == pytest.approx(by_search)
    assert scores.unknown_named(correct, unknown, 0.0) == 0


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
