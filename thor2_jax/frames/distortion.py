"""Lens distortion: the polynomial and rational models of OpenCV (ROS: plumb_bob and rational_polynomial).

Coordinates are x / z and y / z in the camera frame. Coefficients are k1, k2, p1, p2, then k3, then k4, k5, k6.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["DISTORTION_LENGTHS", "distort", "undistort"]

DISTORTION_LENGTHS = (0, 4, 5, 8)
"""Numbers of coefficients: no distortion, plumb_bob without and with k3, rational_polynomial."""

_ITERATIONS = 30

Array = NDArray[np.floating[Any]]


def _terms(x: Array, y: Array, coefficients: Sequence[float]) -> tuple[Array, Array, Array]:
    """Return the radial factor and the tangential terms of both axes."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    squared = x * x + y * y
    radial = (1 + squared * (k1 + squared * (k2 + squared * k3))) / (1 + squared * (k4 + squared * (k5 + squared * k6)))
    product = 2 * x * y
    return radial, p1 * product + p2 * (squared + 2 * x * x), p1 * (squared + 2 * y * y) + p2 * product


def distort(x: Array, y: Array, coefficients: Sequence[float]) -> tuple[Array, Array]:
    """Return where the lens images the directions (x, y) of an ideal pinhole camera."""
    radial, tangential_x, tangential_y = _terms(x, y, coefficients)
    return x * radial + tangential_x, y * radial + tangential_y


def undistort(x: Array, y: Array, coefficients: Sequence[float]) -> tuple[Array, Array]:
    """Return the directions that the lens images at (x, y): the inverse of `distort`, by fixed-point iteration.

    Where the model has no inverse, the result is arbitrary; `distort` of it shows that.
    """
    ideal_x, ideal_y = x, y
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            radial, tangential_x, tangential_y = _terms(ideal_x, ideal_y, coefficients)
            ideal_x, ideal_y = (x - tangential_x) / radial, (y - tangential_y) / radial
    return ideal_x, ideal_y
