"""Temperature scaling against SciPy, scikit-learn and known temperatures."""

import numpy as np
import pytest
from scipy.special import softmax
from sklearn.metrics import log_loss

from thor2_jax.errors import InputError
from thor2_jax.model.fusion import with_temperature
from training.evaluation.scores import expected_calibration_error
from training.fitting.calibration import fit_temperature, negative_log_likelihood


@pytest.mark.parametrize("temperature", [0.4, 1.0, 3.0])
def test_known_temperature_is_recovered(temperature: float) -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, (20_000, 5))
    truth = (softmax(logits, axis=1).cumsum(axis=1) < rng.random((20_000, 1))).sum(axis=1)
    scaled = softmax(logits * temperature, axis=1)
    fitted = fit_temperature(scaled, truth)
    assert fitted == pytest.approx(temperature, rel=0.05)
    correct = scaled.argmax(axis=1) == truth
    before = expected_calibration_error(scaled.max(axis=1), correct)
    after = expected_calibration_error(with_temperature(scaled, fitted).max(axis=1), correct)
    assert after < 0.02
    assert after < before or temperature == 1.0


def test_likelihood_matches_scipy_and_sklearn() -> None:
    rng = np.random.default_rng(1)
    logits, truth = rng.normal(0, 3, (50, 4)), rng.integers(0, 4, 50)
    probabilities = softmax(logits, axis=1)
    np.testing.assert_allclose(with_temperature(probabilities, 2.5), softmax(logits / 2.5, axis=1), rtol=1e-6)
    expected = log_loss(truth, softmax(logits / 2.5, axis=1), labels=range(4))
    assert negative_log_likelihood(probabilities, truth, 2.5) == pytest.approx(expected)
    best = fit_temperature(probabilities, truth)
    grid = [negative_log_likelihood(probabilities, truth, t) for t in np.geomspace(0.01, 100, 400)]
    assert negative_log_likelihood(probabilities, truth, best) <= min(grid) + 1e-9


def test_probabilities_of_zero_and_invalid_arguments() -> None:
    probabilities = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], np.float32)
    assert 1 < fit_temperature(probabilities, np.array([0, 1, 1])) <= 100
    with pytest.raises(InputError, match="shapes"):
        fit_temperature(np.zeros((0, 3)), np.zeros(0, int))
    with pytest.raises(InputError, match=r"truth.* 3; expected 0 to 2"):
        fit_temperature(np.full((2, 3), 1 / 3), np.array([0, 3]))
