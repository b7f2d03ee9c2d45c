"""Colour regions of points on the device (paper, "Color network").

A colour belongs to one or more regions of the network. The 140,608 colours of the grid have only 62 different sets of
regions, so a point carries the number of its region set; region weights are applied after points have been counted.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from colornet import ColorNetwork
from colornet.grid import GRID_LEVELS, GRID_STEP

__all__ = ["RegionSets", "color_sets", "region_sets"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RegionSets:
    """The K different sets of regions that the colours of a network belong to.

    Attributes:
        of_color: [140608] unsigned integers, region set of each grid colour, in the smallest type so that the table
            stays in a cache.
        weights: [K, R] float32, weight 1/m in each of the m regions of a set; rows sum to 1.
    """

    of_color: jax.Array
    weights: jax.Array


def region_sets(network: ColorNetwork) -> RegionSets:
    """Return the region sets of a network as device arrays."""
    bits, of_color = np.unique(network.region_bits, return_inverse=True)
    member = (bits[:, None] >> np.arange(network.n_regions, dtype=np.uint32)) & 1
    weights = member / member.sum(axis=1, keepdims=True)
    # By NumPy: JAX would compile a program for each conversion.
    return RegionSets(
        jax.device_put(of_color.astype(np.min_scalar_type(len(bits)))), jax.device_put(weights.astype(np.float32))
    )


def color_sets(colors: jax.Array, sets: RegionSets) -> jax.Array:
    """Return the region set of each colour, that of the nearest grid colour.

    Args:
        colors: [..., 3] float32 sRGB in [0, 1]; rounded to 8 bits first, halves up.
        sets: region sets of the network.

    Returns:
        [...] int32, rows of `sets.weights`.
    """
    eight_bit = jnp.floor(colors * 255 + 0.5).astype(jnp.int32)
    level = (eight_bit + GRID_STEP // 2) // GRID_STEP
    color = (level[..., 0] * GRID_LEVELS + level[..., 1]) * GRID_LEVELS + level[..., 2]
    return sets.of_color.at[color].get(mode="clip").astype(jnp.int32)
