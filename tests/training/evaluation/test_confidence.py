"""Calibration and refusal against counting by hand, scikit-learn and known temperatures."""

import math

import numpy as np
import pytest
from scipy.special import softmax
from sklearn.metrics import log_loss

from thor2_jax.errors import InputError
from training.evaluation.confidence import (
    accuracy_at_coverage,
    auroc,
    expected_calibration_error,
    fit_temperature,
    negative_log_likelihood,
    reliability,
    with_temperature,
)


def test_calibration_error_counted_by_hand() -> None:
    """Two answers in bin 7 of 15 (0.4667 to 0.5333), three in the last, one in the first."""
    confidence = [0.5, 0.52, 0.95, 0.97, 1.0, 0.0]
    right = [True, False, True, True, False, False]
    found = reliability(confidence, right)
    assert found.answers.tolist() == [1] + [0] * 6 + [2] + [0] * 6 + [3]
    assert found.accuracy[[0, 7, 14]] == pytest.approx([0, 1 / 2, 2 / 3])
    assert found.confidence[[0, 7, 14]] == pytest.approx([0, 0.51, 2.92 / 3])
    assert np.isnan(found.accuracy[1])
    by_hand = (1 * 0 + 2 * abs(0.5 - 0.51) + 3 * abs(2 / 3 - 2.92 / 3)) / 6
    assert expected_calibration_error(confidence, right) == pytest.approx(by_hand)


def test_bins_hold_their_upper_edge() -> None:
    assert reliability([0.5, 0.5000001, 1.0], [True] * 3, bins=2).answers.tolist() == [1, 2]


def test_without_answers_there_is_no_error_to_tell() -> None:
    assert math.isnan(expected_calibration_error([], []))
    assert all(math.isnan(value) for value in accuracy_at_coverage([], []))


@pytest.mark.parametrize("temperature", [0.4, 1.0, 3.0])
def test_temperature_of_logits_that_are_off_by_a_known_factor(temperature: float) -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, (20_000, 5))
    truth = (softmax(logits, axis=1).cumsum(axis=1) < rng.random((20_000, 1))).sum(axis=1)
    claimed = softmax(logits * temperature, axis=1)
    fitted = fit_temperature(claimed, truth)
    assert fitted == pytest.approx(temperature, rel=0.05)
    right = claimed.argmax(axis=1) == truth
    before = expected_calibration_error(claimed.max(axis=1), right)
    after = expected_calibration_error(with_temperature(claimed, fitted).max(axis=1), right)
    assert after < 0.02
    assert after < before or temperature == 1.0


def test_likelihood_and_temperature_against_scipy_and_sklearn() -> None:
    rng = np.random.default_rng(1)
    logits, truth = rng.normal(0, 3, (50, 4)), rng.integers(0, 4, 50)
    probabilities = softmax(logits, axis=1)
    np.testing.assert_allclose(with_temperature(probabilities, 2.5), softmax(logits / 2.5, axis=1), rtol=1e-6)
    expected = log_loss(truth, softmax(logits / 2.5, axis=1), labels=range(4))
    assert negative_log_likelihood(probabilities, truth, 2.5) == pytest.approx(expected)
    best = fit_temperature(probabilities, truth)
    grid = [negative_log_likelihood(probabilities, truth, t) for t in np.geomspace(0.01, 100, 400)]
    assert negative_log_likelihood(probabilities, truth, best) <= min(grid) + 1e-9


def test_probabilities_of_zero_are_no_obstacle() -> None:
    probabilities = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], np.float32)
    assert 1 < fit_temperature(probabilities, np.array([0, 1, 1])) <= 100


def test_auroc_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(2)
    confidence, positive = rng.integers(0, 6, 40) / 5, rng.random(40) < 0.4
    pairs = [(0.5 if p == n else float(p > n)) for p in confidence[positive] for n in confidence[~positive]]
    assert auroc(confidence, positive) == pytest.approx(np.mean(pairs))
    assert math.isnan(auroc([0.1, 0.2], [True, True]))


def test_coverage_counted_by_hand() -> None:
    confidence = np.arange(1, 21) / 20
    right = np.ones(20, bool)
    right[[0, 5]] = False
    found = accuracy_at_coverage(confidence, right)
    assert (found.threshold, found.kept, found.accuracy) == pytest.approx((0.1, 0.95, 18 / 19))
    assert accuracy_at_coverage(confidence, right, 1.0).accuracy == pytest.approx(0.9)
    tied = accuracy_at_coverage([0.5, 0.5, 0.9], [False, True, True], 0.5)
    assert (tied.threshold, tied.kept) == (0.5, 1.0)


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match=r"shapes \(2,\) and \(1,\)"):
        reliability([0.1, 0.2], [True])
    with pytest.raises(InputError, match=r"1\.5"):
        auroc([1.5, 0.2], [True, False])
    with pytest.raises(InputError, match="coverage is 0"):
        accuracy_at_coverage([0.5], [True], 0)
    with pytest.raises(InputError, match="shapes"):
        fit_temperature(np.zeros((0, 3)), np.zeros(0, int))
    with pytest.raises(InputError, match="index 3; there are 3 classes"):
        fit_temperature(np.full((2, 3), 1 / 3), np.array([0, 3]))
