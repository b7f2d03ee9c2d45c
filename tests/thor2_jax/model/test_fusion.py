"""Fusion of the classifiers: the three rules against SciPy and known values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from scipy.stats import gmean

from thor2_jax.model.fusion import FUSION_RULES, FusionRule, fused_probabilities, with_temperature

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("n", [0, 1, 101])
@pytest.mark.parametrize("rule", FUSION_RULES)
def test_rules_against_scipy(n: int, rule: FusionRule) -> None:
    tops, tops2 = (scipy.special.softmax(RNG.normal(size=(n, 4)), axis=1) for _ in range(2))
    by_rule = {
        "max": lambda pair: max(pair, key=max),
        "mean": lambda pair: (pair[0] + pair[1]) / 2,
        "log-mean": lambda pair: gmean(pair) / gmean(pair).sum(),
    }
    expected = [by_rule[rule](pair) for pair in zip(tops, tops2, strict=True)]
    result = fused_probabilities({"tops": tops, "tops2": tops2}, rule)
    np.testing.assert_allclose(result, np.reshape(expected, (n, 4)), rtol=1e-12)


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


@pytest.mark.parametrize("n", [0, 1, 101])
@pytest.mark.parametrize("rule", FUSION_RULES)
def test_jax_arrays_are_fused_as_numpy_arrays(rule: FusionRule, n: int) -> None:
    rows = {name: np.asarray(jax.nn.softmax(RNG.normal(size=(n, 4)))) for name in ("tops", "tops2", "ce")}
    fused = jax.jit(lambda p: fused_probabilities(p, rule))({name: jnp.asarray(p) for name, p in rows.items()})
    assert isinstance(fused, jax.Array) and isinstance(fused_probabilities(rows, rule), np.ndarray)
    # Compiled functions get the classifiers in the order of their names.
    expected = fused_probabilities(dict(sorted(rows.items())), rule)
    np.testing.assert_allclose(fused, expected, rtol=1e-5, atol=1e-7)
