"""Slices, strips and their colour vectors (paper, sections "Slicing" and "Colour").

`strips_of_cloud` turns one aligned cloud of any number of points into tables of a fixed size. The paper's rule is in
this module; `released` has the rule of the authors' released code and `relaxation` the soft one.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.color_membership import RegionSets
from thor2_jax.descriptor.relaxation import relaxed_strips
from thor2_jax.descriptor.released import released_slices_and_strips, released_values
from thor2_jax.types import Strips

__all__ = ["slices_and_strips", "strip_births", "strips_of_cloud"]


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
    if config.convention == "released":
        return released_slices_and_strips(x, z, mask, config)
    return jnp.floor(z / config.sigma_1).astype(jnp.int32), jnp.floor(x / config.sigma_2).astype(jnp.int32)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _extremes(y: jax.Array, segment: jax.Array, n_segments: int) -> tuple[jax.Array, jax.Array]:
    """Return the least and the greatest `y` [N] of each segment, [n_segments] each; inf and -inf if it is empty.

    Points whose segment number is `n_segments` or more are dropped. The gradient of an extreme reaches exactly one
    point, even if several points tie.
    """
    keys = jnp.stack([-y, y], axis=-1)
    best = jnp.full((n_segments, 2), -jnp.inf, y.dtype).at[segment].max(keys, mode="drop")
    return -best[:, 0], best[:, 1]


@_extremes.defjvp
def _extremes_jvp(n_segments: int, primals: Any, tangents: Any) -> Any:
    y, segment = primals
    extremes = _extremes(y, segment, n_segments)
    row = jnp.minimum(segment, n_segments - 1)
    number = jnp.arange(len(y), dtype=jnp.int32)

    def tangent(values: jax.Array) -> jax.Array:
        candidate = jnp.where(y == values[row], number, -1)
        index = jnp.full(n_segments, -1, jnp.int32).at[segment].max(candidate, mode="drop")
        return jnp.where(index >= 0, tangents[0][jnp.maximum(index, 0)], 0)

    return extremes, tuple(tangent(values) for values in extremes)


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
    return released_values(strips) if config.convention == "released" else strips


def _color_vectors(segment: jax.Array, region_set: jax.Array, sets: RegionSets, n_segments: int) -> jax.Array:
    """Return the sums of the points' region weights in each segment, [n_segments, R]."""
    # Points are counted by region set first: one addition a point instead of one for each point and region.
    n_sets = sets.weights.shape[0]
    cell = segment * n_sets + region_set
    counts = jnp.zeros(n_segments * n_sets, jnp.float32).at[cell].add(1, mode="drop")
    return jnp.matmul(counts.reshape(n_segments, n_sets), sets.weights, precision=jax.lax.Precision.HIGHEST)
