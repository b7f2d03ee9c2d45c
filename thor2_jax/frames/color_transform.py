"""A camera's colour transform: gamma, gain, saturation and warmth, which correct colours before recognition."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet.lab import LUMA
from thor2_jax.errors import InputError

__all__ = ["MAX_PARAMETER", "ColorTransform", "transform_colors"]

MAX_PARAMETER = 1.5
"""Largest absolute value of a parameter: a factor of 4.5 of gamma, gain or saturation."""


def transform_colors(parameters: jax.Array, colors: jax.Array) -> jax.Array:
    """Return transformed colours [..., 3] in [0, 1].

    Args:
        parameters: [4], the fields of `ColorTransform` in their order.
        colors: [..., 3] sRGB in [0, 1].
    """
    gamma, gain, saturation, warmth = parameters
    values = colors ** jnp.exp(gamma) * jnp.exp(gain + warmth * jnp.array([1, 0, -1], jnp.float32))
    grey = (values * LUMA).sum(axis=-1, keepdims=True)
    return jnp.clip(grey + jnp.exp(saturation) * (values - grey), 0, 1)


@dataclasses.dataclass(frozen=True)
class ColorTransform:
    """Colours c in [0, 1] become exp(gain) exp(warmth [1, 0, -1]) c^exp(gamma), then the distance from grey is scaled.

    With all parameters 0, nothing changes.

    Attributes:
        gamma: logarithm of the exponent.
        gain: logarithm of the factor of all channels.
        saturation: logarithm of the factor of a colour's distance from grey.
        warmth: logarithm of the factor of red, and of one over the factor of blue.

    Raises:
        InputError: a parameter is not a finite number, or its absolute value is above `MAX_PARAMETER`.
    """

    gamma: float = 0.0
    gain: float = 0.0
    saturation: float = 0.0
    warmth: float = 0.0

    def __post_init__(self) -> None:
        values = dataclasses.astuple(self)
        if not all(isinstance(value, (int, float)) and abs(value) <= MAX_PARAMETER for value in values):
            raise InputError(
                f"color_transform is {values}; expected gamma, gain, saturation and warmth from {-MAX_PARAMETER} to "
                f"{MAX_PARAMETER}: adapt the run again"
            )

    def __call__(self, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the corrected colours of colours [..., 3] uint8 sRGB."""
        gamma, gain, saturation, warmth = dataclasses.astuple(self)
        # The channels are powers of 256 values, which a table holds.
        powers = (np.arange(256) / 255) ** np.exp(gamma)
        values = powers[colors] * np.exp(gain + warmth * np.array([1, 0, -1]))
        grey = (values @ LUMA)[..., None]
        return np.rint(255 * (grey + np.exp(saturation) * (values - grey))).clip(0, 255).astype(np.uint8)
