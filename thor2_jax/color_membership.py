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
        of_color: [140608] int32, set of each grid colour.
        weights: [K, R] float32, weight 1/m in each of a set's m regions; rows sum to 1.
    """

    of_color: jax.Array
    weights: jax.Array


def region_sets(network: ColorNetwork) -> RegionSets:
    """The sets of a network's regions, as device arrays."""
    bits, of_color = np.unique(network.region_bits, return_inverse=True)
    member = (bits[:, None] >> np.arange(network.n_regions, dtype=np.uint32)) & 1
    weights = member / np.maximum(member.sum(axis=1, keepdims=True), 1)
    return RegionSets(jnp.asarray(of_color, jnp.int32), jnp.asarray(weights, jnp.float32))


def color_sets(colors: jax.Array, sets: RegionSets) -> jax.Array:
    """Set of each colour, looked up at the nearest grid colour.

    Args:
        colors: [..., 3] float32 sRGB in [0, 1]; rounded to 8 bits first, halves up.
        sets: of the network.

    Returns:
        [...] int32, rows of `sets.weights`.
    """
    eight_bit = jnp.floor(colors * 255 + 0.5).astype(jnp.int32)
    level = (eight_bit + GRID_STEP // 2) // GRID_STEP
    return sets.of_color[(level[..., 0] * GRID_LEVELS + level[..., 1]) * GRID_LEVELS + level[..., 2]]
