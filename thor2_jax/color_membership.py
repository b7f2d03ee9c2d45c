"""Region weights of colours on the device (colour network, membership).

A grid colour's regions are a bit mask, unpacked point by point.
"""

import jax
import jax.numpy as jnp

from colornet.grid import GRID_LEVELS, GRID_STEP

__all__ = ["region_weights"]


def region_weights(colors: jax.Array, region_bits: jax.Array, n_regions: int) -> jax.Array:
    """Weight 1/m in each of a colour's m regions, looked up at the nearest grid colour.

    Args:
        colors: [..., 3] float32 sRGB in [0, 1]; rounded to 8 bits first, halves up.
        region_bits: [140608] uint32, `ColorNetwork.region_bits`.
        n_regions: R.

    Returns:
        [..., R] float32; rows sum to 1.
    """
    eight_bit = jnp.floor(colors * 255 + 0.5).astype(jnp.int32)
    level = (eight_bit + GRID_STEP // 2) // GRID_STEP
    index = (level[..., 0] * GRID_LEVELS + level[..., 1]) * GRID_LEVELS + level[..., 2]
    bits = region_bits[index]
    member = (bits[..., None] >> jnp.arange(n_regions, dtype=jnp.uint32)) & 1
    return member / jnp.maximum(jax.lax.population_count(bits), 1)[..., None].astype(jnp.float32)
