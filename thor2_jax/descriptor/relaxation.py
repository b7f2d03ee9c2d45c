"""The relaxed descriptor: slices, strips, extremes and colour regions whose gradients do not vanish.

Hard slices, strips and colour regions are piecewise constant in points and colours. With
`DescriptorConfig(relaxation=Relaxation(...))` a point has a weight in each of them. As all four temperatures approach
zero, the results approach those of `slicing`, for any cloud in the first octant that has no point on a border between
two slices or strips and no colour halfway between two grid colours.

>>> config = DescriptorConfig(relaxation=Relaxation(color=2.0))               # doctest: +SKIP
>>> descriptors = describe(clouds, network, config)                                 # doctest: +SKIP
"""

import functools
import itertools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from colornet.grid import GRID_LEVELS, GRID_STEP, grid_colors
from thor2_jax.config import DescriptorConfig, Relaxation
from thor2_jax.descriptor.bounding_box import HIGHEST
from thor2_jax.descriptor.cloud_statistics import square_root, to_lab
from thor2_jax.types import Strips

if TYPE_CHECKING:
    from thor2_jax.descriptor.slicing import RegionSets

__all__ = ["hyab", "interval_log_weights", "relaxed_strips", "soft_regions"]


_OFFSETS = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
"""[27, 3] offsets, in levels, from the nearest grid colour to itself and its neighbours."""

_WEIGHT_FLOOR = 1e-3
"""Where the weights in a strip are smaller than this, its mean is pulled to 0, which keeps the quotient bounded."""


def interval_log_weights(coordinates: jax.Array, width: float, count: int, temperature: float) -> jax.Array:
    """Return the logarithms of the weights of coordinates in consecutive intervals that start at 0.

    A weight is sigmoid((x - lower) / T) - sigmoid((x - upper) / T). The first interval is unbounded below: aligned
    clouds touch 0, and a point on that border belongs to no other interval.

    Args:
        coordinates: [N].
        width: width of an interval, in the unit of `coordinates`.
        count: number C of intervals.
        temperature: T, in the unit of `coordinates`.

    Returns:
        [N, C], at most 0. The weights sum to 1 for coordinates well below the last border.
    """
    edges = (np.arange(count + 1) * width).astype(np.float32)
    above = jax.nn.log_sigmoid((coordinates[:, None] - edges[1:-1]) / temperature)
    below = jax.nn.log_sigmoid((edges[1:] - coordinates[:, None]) / temperature)
    # Written as a product, the difference loses no digits where both sigmoids are nearly equal.
    between = above + below[:, 1:] + np.log1p(-np.exp(-width / temperature))
    return jnp.concatenate([below[:, :1], between], axis=1)


def _rise(weight: jax.Array, above: jax.Array, temperature: float) -> jax.Array:
    """Return T log(1 + sum over points of w (exp(above / T) - 1)): [N, J] and [N, J] to [J].

    This log-sum-exp ignores points of weight 0 and is 0 if `above` is 0 everywhere. It is not negative if the weighted
    sum of `above` is 0.
    """
    scaled = above / temperature
    top = jax.lax.stop_gradient(jnp.maximum(scaled.max(axis=0), 0))
    floor = jnp.exp(-jnp.minimum(top, 80.0))
    terms = (weight * jnp.exp(scaled - top)).sum(axis=0) + (1 - weight.sum(axis=0)) * jnp.exp(-top)
    return temperature * (top + jnp.log(jnp.maximum(terms, floor)))


def relaxed_strips(
    points: jax.Array,
    colors: jax.Array,
    mask: jax.Array,
    sets: "RegionSets",
    config: DescriptorConfig,
    overflow: jax.Array,
    point_weights: jax.Array | None = None,
) -> Strips:
    """Return the soft extremes and the colour vector of every strip of one aligned cloud (no batch axis).

    Let w be the weight of a point in a strip and m the mean of y with the weights w^2. The upper extreme is
    m + T log(1 + sum w (exp(w (y - m) / T) - 1)), and the lower one likewise. Deviations are multiplied by w too;
    otherwise a point high up in the next strip would dominate at any temperature in spite of its small weight. A strip
    that holds little weight or only one point has little persistence and vanishes from the image.

    Args:
        points: [3, N], scaled units; points with a negative x or z are ignored, as in hard slices.
        colors: [N, 3] sRGB in [0, 1].
        mask: [N] bool.
        sets: region sets of the colour network.
        config: its `relaxation` gives the temperatures. Static.
        overflow: [] int32, returned unchanged.
        point_weights: [N] float32 from 0 to 1, by which each point counts; a point of weight 0 is left out. By default
            all points count fully. Their gradients attribute an answer to points (`explanation.attributions`).

    Returns:
        Strips; a strip is occupied if any point has a positive weight in it.
    """
    relaxation = config.relaxation or Relaxation()
    x, y, z = points
    counted = (mask & (x >= 0) & (z >= 0))[:, None]
    log_slice = interval_log_weights(z, config.sigma_1, config.n_slices, relaxation.slice)
    log_strip = interval_log_weights(x, config.sigma_2, config.n_strips, relaxation.strip)
    regions = soft_regions(colors, sets, relaxation.color)

    # With a checkpoint, the gradient recomputes the [N, J] arrays of a slice instead of keeping those of all slices.
    @jax.checkpoint
    def one_slice(log_weight: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        weight = jnp.where(counted, jnp.exp(log_weight[:, None] + log_strip), 0)
        if point_weights is not None:
            weight = weight * point_weights[:, None]
        square = weight**2
        mean = (square * y[:, None]).sum(axis=0) / (square.sum(axis=0) + _WEIGHT_FLOOR**2)
        above = weight * (y[:, None] - mean)
        low = mean - _rise(weight, -above, relaxation.extremum)
        high = mean + _rise(weight, above, relaxation.extremum)
        return low, high, (weight > 0).any(axis=0), jnp.matmul(weight.T, regions, precision=HIGHEST)

    low, high, occupied, color = jax.lax.map(one_slice, log_slice.T)
    return Strips(low, high, occupied, color, overflow)


def hyab(first: jax.Array, second: jax.Array) -> jax.Array:
    """Return the HyAB difference |dL*| + sqrt(da*^2 + db*^2), [..., 3] to [...]; its gradient is 0 at equal colours."""
    difference = first - second
    return jnp.abs(difference[..., 0]) + square_root((difference[..., 1:] ** 2).sum(axis=-1))


@functools.cache
def _grid_lab() -> jax.Array:
    with jax.ensure_compile_time_eval():
        return to_lab(jnp.asarray(grid_colors() / 255, jnp.float32))


def soft_regions(colors: jax.Array, sets: "RegionSets", temperature: float) -> jax.Array:
    """Return region weights of colours, averaged over nearby grid colours by a softmax over HyAB distances.

    The 27 grid colours within one level of the nearest one share the weight in proportion to exp(-HyAB / T), times a
    factor that fades to 0 where a channel is 1/2 + T / (1 + T) levels away. The weights are therefore continuous where
    the nearest grid colour changes. Towards zero temperature only the colour nearest in every channel remains, as in
    the hard rule; the colour nearest by HyAB may be another one.

    Args:
        colors: [N, 3] sRGB, clipped to [0, 1] first.
        sets: region sets of the colour network.
        temperature: T, units of HyAB in CIELAB.

    Returns:
        [N, R]; rows sum to 1.
    """
    colors = jnp.clip(colors, 0, 1)
    scaled = colors * (255 / GRID_STEP)
    nearest = jnp.floor(scaled + 0.5).astype(jnp.int32)
    levels = nearest[:, None] + _OFFSETS.astype(np.int32)
    exists = ((levels >= 0) & (levels < GRID_LEVELS)).all(axis=-1)
    levels = jnp.clip(levels, 0, GRID_LEVELS - 1)
    row = (levels[..., 0] * GRID_LEVELS + levels[..., 1]) * GRID_LEVELS + levels[..., 2]

    reach = 0.5 + temperature / (1 + temperature)
    closeness = 1 - ((scaled[:, None] - levels.astype(scaled.dtype)) / reach) ** 2
    # The nearest colour always stays; at a tiny temperature rounding could exclude it.
    chosen = exists & ((closeness > 0).all(axis=-1) | ~_OFFSETS.any(axis=-1))
    fade = 2 * jnp.log(jnp.where(closeness > 0, closeness, 1e-7)).sum(axis=-1)
    distance = hyab(to_lab(colors)[:, None], _grid_lab()[row])
    share = jax.nn.softmax(jnp.where(chosen, fade - distance / temperature, -jnp.inf), axis=-1)

    # Summed by region set first: [N, 62] instead of [N, 27, 22].
    by_set = jnp.zeros((len(colors), sets.weights.shape[0]), share.dtype)
    by_set = by_set.at[jnp.arange(len(colors))[:, None], sets.of_color[row]].add(share)
    return jnp.matmul(by_set, sets.weights, precision=HIGHEST)
