"""Slices, strips and their colour vectors (paper, sections "Slicing" and "Colour").

`strips_of_cloud` turns one aligned cloud of any number of points into tables of a fixed size. The paper's rule, and
that of the authors' released code (`DescriptorConfig.released`), are in this module, and the soft one in `relaxation`.

A colour belongs to one or more regions of the network (paper, "Color network"). The 140,608 colours of the grid have
only 62 different sets of regions, so a point carries the number of its region set; region weights are applied after
points have been counted.

The released code rounds x and y to 0.01 and z to 0.1, half to even, in float64. Slices are the levels of z that occur,
renumbered from 0; a strip is numbered by its upper edge; colour vectors are divided by their strip's number of points.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from colornet import ColorNetwork
from colornet.grid import GRID_LEVELS, GRID_STEP
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.relaxation import relaxed_strips
from thor2_jax.types import Strips

__all__ = ["RegionSets", "color_sets", "region_sets", "slices_and_strips", "strip_births", "strips_of_cloud"]


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


@functools.lru_cache(maxsize=8)
def region_sets(network: ColorNetwork) -> RegionSets:
    """Return the region sets of a network as device arrays."""
    bits, of_color = np.unique(network.region_bits, return_inverse=True)
    member = (bits[:, None] >> np.arange(network.n_regions, dtype=np.uint32)) & 1
    weights = member / member.sum(axis=1, keepdims=True)
    fields = of_color.astype(np.min_scalar_type(len(bits))), weights.astype(np.float32)
    # The result outlives the call, so it must be concrete even if the first call happens while a function is traced.
    with jax.ensure_compile_time_eval():
        return RegionSets(*jax.device_put(fields))  # of NumPy arrays: JAX would compile a program for each conversion


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


_COORDINATE_LIMIT = 2.0**20
"""Coordinates are clipped to this, far beyond any descriptor, so that hundredths of them fit into int32."""


def strip_births(config: DescriptorConfig) -> jax.Array:
    """Return the filtration values at which the strips' vertices enter, j * sigma_2: [J] float32, scaled units."""
    # Computed by NumPy: XLA may fuse a product on the device with a sum, and programs would differ in the last bit.
    return jnp.asarray(np.arange(config.n_strips) * config.sigma_2, jnp.float32)


def slices_and_strips(
    x: jax.Array, z: jax.Array, mask: jax.Array, config: DescriptorConfig
) -> tuple[jax.Array, jax.Array]:
    """Return the slice and strip number of each point of one aligned cloud.

    In the paper's convention slice i is {i s1 <= z < (i + 1) s1} and strip j is {j s2 <= x < (j + 1) s2}.

    Args:
        x: [N] float32, scaled units, first octant.
        z: [N] float32, likewise.
        mask: [N] bool.
        config: static.

    Returns:
        Two [N] int32 arrays. Numbers may lie outside the descriptor; those of padding are meaningless.
    """
    if config.convention == "paper":
        return jnp.floor(z / config.sigma_1).astype(jnp.int32), jnp.floor(x / config.sigma_2).astype(jnp.int32)
    # Rounded to 0.01, x is k / 100. The first edge j / 40 at or above it has j = ceil(2 k / 5), in integer arithmetic.
    strip = (2 * _round_scaled(jnp.clip(x, -_COORDINATE_LIMIT, _COORDINATE_LIMIT), 100).astype(jnp.int32) + 4) // 5
    level = _round_scaled(z, 10).astype(jnp.int32)
    # Levels from twice the number of slices on keep their own number, which is outside the descriptor.
    n_levels = 2 * config.n_slices
    ranked = (level >= 0) & (level < n_levels)
    occurs = jnp.zeros(n_levels, jnp.int32).at[jnp.where(mask & ranked, level, n_levels)].set(1, mode="drop")
    rank = jnp.cumsum(occurs) - 1
    return jnp.where(ranked, rank[jnp.clip(level, 0, n_levels - 1)], level), strip


def _extremes(y: jax.Array, segment: jax.Array, n_segments: int) -> tuple[jax.Array, jax.Array]:
    """Return the least and the greatest `y` [N] of each segment, [n_segments] each; inf and -inf if it is empty.

    Points whose segment number is `n_segments` or more are dropped. Points that tie share the gradient of an extreme.
    """
    keys = jnp.stack([-y, y], axis=-1)
    best = jnp.full((n_segments, 2), -jnp.inf, y.dtype).at[segment].max(keys, mode="drop")
    return -best[:, 0], best[:, 1]


def strips_of_cloud(
    points: jax.Array,
    colors: jax.Array,
    mask: jax.Array,
    region_set: jax.Array,
    sets: RegionSets,
    config: DescriptorConfig,
) -> Strips:
    """Return the extremes and the colour vector of every strip of one aligned cloud (no batch axis).

    Args:
        points: [3, N], scaled units, first octant.
        colors: [N, 3] sRGB in [0, 1]; only a relaxation reads them.
        mask: [N] bool.
        region_set: [N] int32, row of `sets.weights` for each point, as `color_sets` returns it.
        sets: the region sets of the colour network.
        config: static.
    """
    n_segments = config.n_slices * config.n_strips
    x, y, z = points
    i, j = slices_and_strips(x, z, mask, config)
    # NaN and infinity would be converted to valid slice and strip numbers.
    inside = mask & jnp.isfinite(x) & jnp.isfinite(y) & jnp.isfinite(z)
    inside &= (i >= 0) & (i < config.n_slices) & (j >= 0) & (j < config.n_strips)
    overflow = (mask & ~inside).sum(dtype=jnp.int32)
    if config.relaxation is not None:
        return relaxed_strips(points, colors, mask, sets, config, overflow)

    segment = jnp.where(inside, i * config.n_strips + j, n_segments)  # the scatters drop segment `n_segments`
    low, high = _extremes(y, segment, n_segments)
    occupied = low <= high
    color = _color_vectors(segment, region_set, sets, n_segments)

    def grid(a: jax.Array) -> jax.Array:
        return a.reshape(config.n_slices, config.n_strips, *a.shape[1:])

    strips = Strips(
        low=grid(jnp.where(occupied, low, 0)),
        high=grid(jnp.where(occupied, high, 0)),
        occupied=grid(occupied),
        color=grid(color),
        overflow=overflow,
    )
    return _released_values(strips) if config.convention == "released" else strips


def _color_vectors(segment: jax.Array, region_set: jax.Array, sets: RegionSets, n_segments: int) -> jax.Array:
    """Return the sums of the points' region weights in each segment, [n_segments, R]."""
    # Points are counted by region set first: one addition a point instead of one for each point and region.
    n_sets = sets.weights.shape[0]
    cell = segment * n_sets + region_set
    counts = jnp.zeros(n_segments * n_sets, jnp.float32).at[cell].add(1, mode="drop")
    return jnp.matmul(counts.reshape(n_segments, n_sets), sets.weights, precision=jax.lax.Precision.HIGHEST)


def _released_values(strips: Strips) -> Strips:
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
