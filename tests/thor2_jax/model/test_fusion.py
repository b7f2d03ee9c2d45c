"""Fusion by three rules against SciPy and known values; confidence: its formula and what the recognizer makes of it."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest
import scipy.special
from scipy.stats import gmean
from small_runs import untrained_embedding_run, untrained_run

import thor2_jax as thor2
from thor2_jax.model.fusion import FUSION_RULES, Calibration, answer_features, fused_probabilities, with_temperature
from thor2_jax.model.model import Model

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("n", [0, 1, 101])
@pytest.mark.parametrize("rule", FUSION_RULES)
def test_rules_of_numpy_and_jax_arrays_against_scipy(n: int, rule: Any) -> None:
    rows = {name: scipy.special.softmax(RNG.normal(size=(n, 4)), axis=1) for name in ("ce", "tops", "tops2")}
    by_rule = {
        "max": lambda each: max(each, key=max),
        "mean": lambda each: np.mean(each, axis=0),
        "log-mean": lambda each: gmean(each) / gmean(each).sum(),
    }
    expected = np.reshape([by_rule[rule](each) for each in zip(*rows.values(), strict=True)], (n, 4))
    fused, compiled = fused_probabilities(rows, rule), jax.jit(lambda p: fused_probabilities(p, rule))(rows)
    assert isinstance(fused, np.ndarray) and isinstance(compiled, jax.Array)
    np.testing.assert_allclose(fused, expected, rtol=1e-12)
    np.testing.assert_allclose(compiled, expected, rtol=1e-5, atol=1e-7)


def test_a_class_that_one_classifier_rules_out_loses() -> None:
    """Classes with a probability of 0 have no logarithm; both classifiers rule out the third class."""
    first, second = np.array([[0.9, 0.1, 0.0]], np.float32), np.array([[0.0, 1.0, 0.0]], np.float32)
    np.testing.assert_allclose(fused_probabilities({"tops": first, "tops2": second}), [[0, 1, 0]], atol=1e-6)


def test_the_first_classifier_wins_a_tie_and_one_is_enough() -> None:
    first, second = np.array([[0.3, 0.7]]), np.array([[0.7, 0.3]])
    np.testing.assert_array_equal(fused_probabilities({"tops": first, "tops2": second}, "max"), first)
    np.testing.assert_allclose(fused_probabilities({"tops2": second}), second)


@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.5])
def test_a_temperature_is_a_power_of_the_probabilities(temperature: float) -> None:
    probabilities = np.array([[0.5, 0.3, 0.2], [0.01, 0.98, 0.01]])
    powers = probabilities ** (1 / temperature)
    expected = powers / powers.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(with_temperature(probabilities, temperature), expected, rtol=1e-12)


FUSED = np.array([[0.7, 0.2, 0.1], [0.2, 0.2, 0.6]])
EMBEDDED = np.array([[0.4, 0.5, 0.0], [0.01, 0.0, 0.001]])
CALIBRATION = Calibration(-1.0, 0.5, 2.0, 0.25, 0.3, 0.6, 1.5)
RECORD = dataclasses.asdict(CALIBRATION)


def test_the_largest_probability_is_the_confidence() -> None:
    correct = 1 / (1 + np.exp(1 - 0.5 * np.log(0.7 / 0.3)))
    known = 1 / (1 + np.exp(-2 - 0.25 * np.log(0.9 / 0.1)))
    score = correct * known
    confidence = 1 / (1 + np.exp(-0.6) * ((1 - score) / score) ** 1.5)
    values = CALIBRATION.calibrated(FUSED, EMBEDDED)
    np.testing.assert_allclose(values[0], np.array([1, 2 / 7, 1 / 7]) * confidence)
    np.testing.assert_array_equal(values.argmax(axis=1), FUSED.argmax(axis=1))
    assert values[1, 2] < values[0, 0]


def test_extreme_probabilities_have_a_score_below_one() -> None:
    above = np.array([[1 + 1e-7, 0.0]] * 2)  # rounding errors can bring a sum above 1
    np.testing.assert_array_equal(answer_features(above, above * [[0], [1]]), [[8, -8], [8, 8]])
    steep = dataclasses.replace(CALIBRATION, correct_factor=100.0, known_factor=100.0)
    score = steep.score(np.array([[1.0, 0.0]]), np.array([[1.0, 0.0]]))
    assert 0.999 < score[0] < 1


def test_records_without_a_third_function_are_read() -> None:
    calibration = Calibration(**{name: value for name, value in RECORD.items() if not name.startswith("score")})
    np.testing.assert_allclose(calibration.confidence(FUSED, EMBEDDED), CALIBRATION.score(FUSED, EMBEDDED))


BAD_VALUES = ({"unknown_below": 2.0}, {"known_bias": float("nan")}, {"known_bias": "0"})


@pytest.mark.parametrize("record", [[], {"known_bias": 0.0}, *(RECORD | values for values in BAD_VALUES)])
def test_damaged_records_are_refused(record: Any) -> None:
    with pytest.raises(thor2.InputError, match="calibration"):
        Model.of_run(untrained_run("ab", record={"calibration": record}))
    assert Model.of_run(untrained_run("ab")).calibration is None


def test_the_recognizer_uses_the_calibration_of_its_run() -> None:
    run = untrained_embedding_run(("a", "b", "c"), ("tops", "tops2"))
    recognizer = thor2.Recognizer(dataclasses.replace(run, record={"calibration": RECORD}))
    assert recognizer.model.chosen_classifiers() == ("tops", "tops2", "embedding")
    probabilities = {"tops": FUSED, "tops2": FUSED, "embedding": EMBEDDED}
    np.testing.assert_allclose(recognizer.model.fused(probabilities), CALIBRATION.calibrated(FUSED, EMBEDDED))
    # The embedding of another run is no classifier.
    other = thor2.Recognizer(dataclasses.replace(run, classes=("a", "b", "d")))
    assert other.model.chosen_classifiers() == ("tops", "tops2")


@pytest.mark.parametrize("rule", FUSION_RULES)
def test_an_embedding_alone_answers_alike_under_every_rule(rule: Any) -> None:
    recognizer = thor2.Recognizer(untrained_embedding_run(("a", "b", "c"), record={"calibration": RECORD}), rule=rule)
    assert tuple(recognizer.model.classifiers) == recognizer.model.chosen_classifiers() == ("embedding",)
    conditional = EMBEDDED / EMBEDDED.sum(axis=1, keepdims=True)
    expected = CALIBRATION.calibrated(conditional, EMBEDDED)
    np.testing.assert_allclose(recognizer.model.fused({"embedding": EMBEDDED}), expected, rtol=1e-6, atol=1e-12)
