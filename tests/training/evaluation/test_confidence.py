"""Confidence metrics against values computed by hand."""

import numpy as np
import pytest

from thor2_jax.errors import InputError
from training.evaluation.scores import (
    accuracy_at_coverage,
    auroc,
    expected_calibration_error,
    reliability,
    unknown_named,
)


def test_calibration_error_matches_hand_calculation() -> None:
    """Two answers in bin 7 of 15 (0.4667 to 0.5333), three in the last, one in the first."""
    confidence = [0.5, 0.52, 0.95, 0.97, 1.0, 0.0]
    correct = [True, False, True, True, False, False]
    result = reliability(confidence, correct)
    assert result.answers.tolist() == [1] + [0] * 6 + [2] + [0] * 6 + [3]
    assert result.accuracy[[0, 7, 14]] == pytest.approx([0, 1 / 2, 2 / 3])
    assert result.confidence[[0, 7, 14]] == pytest.approx([0, 0.51, 2.92 / 3])
    assert np.isnan(result.accuracy[1])
    by_hand = (1 * 0 + 2 * abs(0.5 - 0.51) + 3 * abs(2 / 3 - 2.92 / 3)) / 6
    assert expected_calibration_error(confidence, correct) == pytest.approx(by_hand)
    # Bins include their upper edge.
    assert reliability([0.5, 0.5000001, 1.0], [True] * 3, bins=2).answers.tolist() == [1, 2]


def test_metrics_without_answers_are_nan() -> None:
    values = [expected_calibration_error([], []), *accuracy_at_coverage([], []), auroc([0.1, 0.2], [True, True])]
    assert np.isnan([*values, unknown_named([], [0.5]), *unknown_named([0.5], [], [0.1, 0.2])]).all()


def test_auroc_is_the_fraction_of_ordered_pairs() -> None:
    rng = np.random.default_rng(2)
    confidence, positive = rng.integers(0, 6, 40) / 5, rng.random(40) < 0.4
    pairs = [(0.5 if p == n else float(p > n)) for p in confidence[positive] for n in confidence[~positive]]
    assert auroc(confidence, positive) == pytest.approx(np.mean(pairs))


def test_coverage_matches_hand_calculation() -> None:
    confidence = np.arange(1, 21) / 20
    correct = np.ones(20, bool)
    correct[[0, 5]] = False
    result = accuracy_at_coverage(confidence, correct)
    assert (result.threshold, result.kept, result.accuracy) == pytest.approx((0.1, 0.95, 18 / 19))
    assert accuracy_at_coverage(confidence, correct, 1.0).accuracy == pytest.approx(0.9)
    tied = accuracy_at_coverage([0.5, 0.5, 0.9], [False, True, True], 0.5)
    assert (tied.threshold, tied.kept) == (0.5, 1.0)


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(InputError, match=r"shapes \(2,\) and \(1,\)"):
        reliability([0.1, 0.2], [True])
    with pytest.raises(InputError, match=r"1\.5"):
        auroc([1.5, 0.2], [True, False])
    with pytest.raises(InputError, match="coverage is 0"):
        accuracy_at_coverage([0.5], [True], 0)
    with pytest.raises(InputError, match="kept"):
        unknown_named([0.5], [0.5], 1.5)


def test_unknown_named_matches_a_search_of_thresholds() -> None:
    """The oracle tries every threshold and takes the largest one that keeps enough."""
    rng = np.random.default_rng(3)
    correct, unknown = rng.integers(0, 12, 20) / 11, rng.integers(0, 12, 15) / 11
    kept = np.array([0.05, 0.5, 0.95, 1.0])
    by_search = []
    for share in kept:
        enough = [t for t in np.unique(correct) if (correct >= t).sum() >= share * len(correct) - 1e-9]
        by_search.append(np.mean(unknown >= max(enough)))
    assert unknown_named(correct, unknown, kept).tolist() == pytest.approx(by_search)
    assert unknown_named([0.9, 0.8, 0.7], [0.95, 0.75, 0.1], 2 / 3) == pytest.approx(1 / 3)
    assert unknown_named([0.5], [0.9], 0.0) == 0
