"""Slices, strips and their colour vectors (paper, sections "Slicing" and "Colour").

An aligned cloud becomes tables of a fixed size.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.color_membership import RegionSets
from thor2_jax.descriptor.relaxation import relaxed_strips
from thor2_jax.types import Strips

__all__ = ["slice_and_strip", "strip_births", "strips_of_cloud"]

_FAR = 2.0**20
"""Scaled units, far past any descriptor: coordinates limited to it, hundredths stay within 32 bits."""


def strip_births(config: DescriptorConfig) -> jax.Array:
    """[J] float32: filtration value at which strip j's vertices enter, j * sigma_2, scaled units."""
    # A constant, not a product on the device: compilers fuse products with sums, and then bits differ between programs.
    return jnp.asarray(np.arange(config.n_strips) * config.sigma_2, jnp.float32)


def slice_and_strip(
    x: jax.Array, z: jax.Array, mask: jax.Array, config: DescriptorConfig
) -> tuple[jax.Array, jax.Array]:
    """Slice and strip number of each point of one aligned cloud.

    Slice i is {i s1 <= z < (i+1) s1}, strip j is {j s2 <= x < (j+1) s2}.

    Args:
        x: [N] float32, scaled units, as `z` of the first octant.
        z: [N] float32.
        mask: [N] bool.
        config: static.

    Returns:
        Two [N] int32 arrays, not limited to the descriptor's size; what padding holds means nothing.
    """
    if config.convention == "paper":
        return jnp.floor(z / config.sigma_1).astype(jnp.int32), jnp.floor(x / config.sigma_2).astype(jnp.int32)
    # Rounded to 0.01, x is k / 100; the first edge j / 40 that is not below it has j = ceil(2 k / 5), in whole numbers.
    strip = (2 * _rounded(jnp.clip(x, -_FAR, _FAR), 100).astype(jnp.int32) + 4) // 5
    level = _rounded(z, 10).astype(jnp.int32)
    # Levels past twice the descriptor's slices get a number past its end whatever their rank.
    n_levels = 2 * config.n_slices
    known = (level >= 0) & (level < n_levels)
    occurs = jnp.zeros(n_levels, jnp.int32).at[jnp.where(mask & known, level, n_levels)].set(1, mode="drop")
    rank = jnp.cumsum(occurs) - 1
    return jnp.where(known, rank[jnp.clip(level, 0, n_levels - 1)], level), strip


def _rounded(values: jax.Array, scale: int) -> jax.Array:
    """Whole number nearest to the exact product of `values` and `scale` (below 128), half to even; float32.

    A product rounded to float32 can land on a half that the exact one misses: 0.015 is stored a little smaller, and
    times 100 is 1.5 in float32. The released code multiplies in float64, where such products are exact.
    """
    whole = jnp.floor(values * scale)
    # Of 24 bits, 12 here and 12 there: each part's product with `scale` is exact, and their sum keeps its sign.
    upper = jax.lax.bitcast_convert_type(
        jax.lax.bitcast_convert_type(values, jnp.uint32) & np.uint32(0xFFFFF000), jnp.float32
    )
    past_half = (upper * scale - (whole + 0.5)) + (values - upper) * scale
    up = (past_half > 0) | ((past_half == 0) & (whole % 2 == 1))
    return whole + up


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _extremes(y: jax.Array, segment: jax.Array, n_segments: int) -> tuple[jax.Array, jax.Array]:
    """Least and greatest of `y` [N] in each segment, [n_segments] twice; inf and -inf where there is none.

    Points of other segment numbers (past the end) are dropped. A gradient reaches exactly one point an extreme, also
    where several are equal.
    """
    keys = jnp.stack([-y, y], axis=-1)
    best = jnp.full((n_segments, 2), -jnp.inf, y.dtype).at[segment].max(keys, mode="drop")
    return -best[:, 0], best[:, 1]


@_extremes.defjvp
def _extremes_jvp(n_segments: int, primals: Any, tangents: Any) -> Any:
    y, segment = primals
    found = _extremes(y, segment, n_segments)
    at = jnp.minimum(segment, n_segments - 1)
    number = jnp.arange(len(y), dtype=jnp.int32)

    def tangent(values: jax.Array) -> jax.Array:
        winner = jnp.where(y == values[at], number, -1)
        index = jnp.full(n_segments, -1, jnp.int32).at[segment].max(winner, mode="drop")
        return jnp.where(index >= 0, tangents[0][jnp.maximum(index, 0)], 0)

    return found, tuple(tangent(values) for values in found)


def strips_of_cloud(
    points: jax.Array,
    colors: jax.Array,
    mask: jax.Array,
    set_of_point: jax.Array,
    sets: RegionSets,
    config: DescriptorConfig,
) -> Strips:
    """Extreme points and colour vectors of every strip of one aligned cloud (no batch axis).

    A config with a relaxation gives the soft ones (`relaxation`).

    Args:
        points: [3, N], scaled units, first octant.
        colors: [N, 3] sRGB, of which a relaxation needs more than their sets.
        mask: [N] bool.
        set_of_point: [N] int32, the set of each point's colour, as of `color_sets`.
        sets: of the colour network's regions.
        config: static.
    """
    n_segments = config.n_slices * config.n_strips
    x, y, z = points
    i, j = slice_and_strip(x, z, mask, config)
    # What is no number would become slice and strip 0.
    inside = mask & jnp.isfinite(x) & jnp.isfinite(y) & jnp.isfinite(z)
    inside &= (i >= 0) & (i < config.n_slices) & (j >= 0) & (j < config.n_strips)
    overflow = (mask & ~inside).sum(dtype=jnp.int32)
    if config.relaxation is not None:
        return relaxed_strips(points, colors, mask, sets, config, overflow)
    segment = jnp.where(inside, i * config.n_strips + j, n_segments)  # past the end: dropped by the scatters

    low, high = _extremes(y, segment, n_segments)
    occupied = low <= high
    extremes = jnp.where(occupied[:, None], jnp.stack([low, high], axis=-1), 0)

    # Counted by set first: one addition a point instead of one a point and region.
    n_sets = sets.weights.shape[0]
    cell = segment * n_sets + set_of_point
    counts = jnp.zeros(n_segments * n_sets, jnp.float32).at[cell].add(1, mode="drop")
    color = jnp.matmul(counts.reshape(n_segments, n_sets), sets.weights, precision=jax.lax.Precision.HIGHEST)
    if config.convention == "released":
        # The released code rounds y, then measures; rounding keeps the order, so the extremes stay extreme.
        extremes = _rounded(jnp.clip(extremes, -_FAR, _FAR), 100) / 100
        color = color / jnp.maximum(color.sum(axis=-1, keepdims=True), 1)

    def grid(a: jax.Array) -> jax.Array:
        return a.reshape(config.n_slices, config.n_strips, *a.shape[1:])

    return Strips(
        low=grid(extremes[:, 0]),
        high=grid(extremes[:, 1]),
        occupied=grid(occupied),
        color=grid(color),
        overflow=overflow,
    )
