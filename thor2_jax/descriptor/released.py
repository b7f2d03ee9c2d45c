"""The slicing convention of the authors' released code (`DescriptorConfig.released`).

The released code rounds x and y to 0.01 and z to 0.1, half to even, in float64. Slices are the levels of z that occur,
renumbered from 0; a strip is numbered by its upper edge; colour vectors are divided by their strip's number of points.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.types import Strips

__all__ = ["released_slices_and_strips", "released_values"]

_COORDINATE_LIMIT = 2.0**20
"""Coordinates are clipped to this, far beyond any descriptor, so that hundredths of them fit into int32."""


def released_slices_and_strips(
    x: jax.Array, z: jax.Array, mask: jax.Array, config: DescriptorConfig
) -> tuple[jax.Array, jax.Array]:
    """Return the slice and strip numbers of points; arguments and results as in `slicing.slices_and_strips`."""
    # Rounded to 0.01, x is k / 100. The first edge j / 40 at or above it has j = ceil(2 k / 5), in integer arithmetic.
    strip = (2 * _round_scaled(jnp.clip(x, -_COORDINATE_LIMIT, _COORDINATE_LIMIT), 100).astype(jnp.int32) + 4) // 5
    level = _round_scaled(z, 10).astype(jnp.int32)
    # Levels from twice the number of slices on keep their own number, which is outside the descriptor.
    n_levels = 2 * config.n_slices
    ranked = (level >= 0) & (level < n_levels)
    occurs = jnp.zeros(n_levels, jnp.int32).at[jnp.where(mask & ranked, level, n_levels)].set(1, mode="drop")
    rank = jnp.cumsum(occurs) - 1
    return jnp.where(ranked, rank[jnp.clip(level, 0, n_levels - 1)], level), strip


def released_values(strips: Strips) -> Strips:
    """Round the extremes of y to 0.01 and divide each colour vector by its strip's number of points."""
    # Rounding keeps the order of numbers, so the extremes of rounded coordinates are the rounded extremes.
    low, high = (
        _round_scaled(jnp.clip(y, -_COORDINATE_LIMIT, _COORDINATE_LIMIT), 100) / 100 for y in (strips.low, strips.high)
    )
    color = strips.color / jnp.maximum(strips.color.sum(axis=-1, keepdims=True), 1)
    return dataclasses.replace(strips, low=low, high=high, color=color)


def _round_scaled(values: jax.Array, scale: int) -> jax.Array:
    """Return the integers nearest to the exact products of `values` and `scale` (below 128), half to even, as float32.

    The released code multiplies in float64, where these products are exact. In float32, 0.015 * 100 rounds to 1.5,
    although the stored number is slightly below 0.015.
    """
    whole = jnp.floor(values * scale)
    # Split the 24-bit significand into 12 and 12 bits: each part's product with `scale` is exact.
    upper = jax.lax.bitcast_convert_type(
        jax.lax.bitcast_convert_type(values, jnp.uint32) & np.uint32(0xFFFFF000), jnp.float32
    )
    past_half = (upper * scale - (whole + 0.5)) + (values - upper) * scale
    round_up = (past_half > 0) | ((past_half == 0) & (whole % 2 == 1))
    return whole + round_up.astype(whole.dtype)
