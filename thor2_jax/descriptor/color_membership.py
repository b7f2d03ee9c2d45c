"""Colour regions of points on the device (colour network, membership).

The network's regions overlap in few ways: its 140,608 grid colours belong to 62 different sets of regions. A point
needs one number, that of its set; weights come in once points have been counted.
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
    """The different sets of regions that colours belong to.

    Attributes:
        of_color: [140608] int, set of each grid colour; of the smallest type, so that the table stays in a cache.
        weights: [K, R] float32, weight 1/m in each of a set's m regions; rows sum to 1.
    """

    of_color: jax.Array
    weights: jax.Array


def region_sets(network: ColorNetwork) -> RegionSets:
    """The sets of a network's regions, as device arrays."""
    bits, of_color = np.unique(network.region_bits, return_inverse=True)
    member = (bits[:, None] >> np.arange(network.n_regions, dtype=np.uint32)) & 1
    weights = member / member.sum(axis=1, keepdims=True)
    return RegionSets(jnp.asarray(of_color, np.min_scalar_type(len(bits))), jnp.asarray(weights, jnp.float32))


def color_sets(colors: jax.Array, sets: RegionSets) -> jax.Array:
    """Set of each colour, looked up at the nearest grid colour.

    Args:
        colors: [..., 3] float32 sRGB in [0, 1]; rounded to 8 bits first, halves up.
        sets: of the network.

    Returns:
        [...] int32, rows of `sets.weights`.
    """
    eight_bit = jnp.floor(colors * 255 + 0.5)
    # In floats, and faster: the nearest level's quotient is at least 1 / 10 away from the next whole number.
    level = jnp.floor((eight_bit + GRID_STEP / 2) * np.float32(1 / GRID_STEP))
    color = (level[..., 0] * GRID_LEVELS + level[..., 1]) * GRID_LEVELS + level[..., 2]
    return sets.of_color.at[color.astype(jnp.int32)].get(mode="clip").astype(jnp.int32)
