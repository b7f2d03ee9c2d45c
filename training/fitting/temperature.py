"""Temperature scaling (Guo et al., "On Calibration of Modern Neural Networks", ICML 2017)."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

from thor2_jax.errors import InputError

__all__ = ["fit_temperature", "negative_log_likelihood"]

Floats = NDArray[np.floating[Any]]


def negative_log_likelihood(probabilities: Floats, truth: NDArray[np.integer[Any]], temperature: float = 1.0) -> float:
    """Return the mean of -log p(true class) over [N, C] probabilities with true class indices `truth` [N]."""
    logits = np.log(np.maximum(np.asarray(probabilities, np.float64), np.finfo(np.float32).tiny))
    return float(-log_softmax(logits / temperature, axis=1)[np.arange(len(truth)), truth].mean())


def fit_temperature(probabilities: Floats, truth: NDArray[np.integer[Any]]) -> float:
    """Return the temperature between 0.01 and 100 that minimizes the negative log-likelihood of a held-out set.

    Args:
        probabilities: [N, C] class probabilities of views that the classifier was not trained on.
        truth: [N] class indices.

    Raises:
        InputError: the shapes do not match, N is 0, or an index is not a class.
    """
    probabilities, truth = np.asarray(probabilities), np.asarray(truth)
    if probabilities.ndim != 2 or truth.shape != probabilities.shape[:1] or len(truth) == 0:
        raise InputError(
            f"probabilities and truth have shapes {probabilities.shape} and {truth.shape}; "
            "expected [N, C] and [N] with N above 0"
        )
    if truth.min() < 0 or truth.max() >= probabilities.shape[1]:
        raise InputError(
            f"truth has values from {truth.min()} to {truth.max()}; expected 0 to {probabilities.shape[1] - 1}"
        )
    optimum = minimize_scalar(
        lambda exponent: negative_log_likelihood(probabilities, truth, math.exp(exponent)),
        bounds=(math.log(0.01), math.log(100)),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return math.exp(optimum.x)
