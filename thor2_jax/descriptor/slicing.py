"""Slices, strips and their colour vectors (paper, sections "Slicing" and "Colour").

`strips_of_cloud` turns one aligned cloud of any number of points into tables of a fixed size, by the paper's rule, that
of the authors' released code (`DescriptorConfig.released`), or a soft one (`DescriptorConfig.relaxation`).

A colour belongs to one or more regions of the network (paper, "Color network"). The 140,608 colours of the grid have
only 62 different sets of regions, so a point carries the number of its region set; region weights are applied after
points have been counted.

The released code rounds x and y to 0.01 and z to 0.1, half to even, in float64. Slices are the levels of z that occur,
renumbered from 0; a strip is numbered by its upper edge; colour vectors are divided by their strip's number of points.

Hard slices, strips and colour regions are piecewise constant in points and colours, and their gradients vanish. With
`DescriptorConfig(relaxation=Relaxation(...))` a point has a weight in each of them. As all four temperatures approach
zero, the results approach the hard ones. This holds for clouds in the first octant without points on the borders of
slices and strips and without colours halfway between grid colours.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from colornet import ColorNetwork
from colornet.colors import GRID_LEVELS, GRID_STEP, grid_colors
from thor2_jax.config import DescriptorConfig, Relaxation
from thor2_jax.types import Strips, matmul

__all__ = [
    "RegionSets",
    "color_sets",
    "region_sets",
    "relaxed_strips",
    "slices_and_strips",
    "square_root",
    "strip_births",
    "strips_of_cloud",
    "to_lab",
]


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
    _, first, of_color = np.unique(network.region_bits, return_index=True, return_inverse=True)
    fields = of_color.astype(np.min_scalar_type(len(first))), network.membership(grid_colors()[first])
    # The result outlives the call, so it must be concrete even if the first call happens while a function is traced.
    with jax.ensure_compile_time_eval():
        return RegionSets(*jax.device_put(fields))  # from NumPy arrays, since JAX would compile each conversion


def color_sets(colors: jax.Array, sets: RegionSets) -> jax.Array:
    """Return the region set of each colour, which is that of the nearest grid colour.

    Args:
        colors: [..., 3] float32 sRGB in [0, 1]; they are rounded to 8 bits first, halves up.
        sets: region sets of the network.

    Returns:
        [...] int32, rows of `sets.weights`.
    """
    eight_bit = jnp.floor(colors * 255 + 0.5).astype(jnp.int32)
    level = (eight_bit + GRID_STEP // 2) // GRID_STEP
    color = (level[..., 0] * GRID_LEVELS + level[..., 1]) * GRID_LEVELS + level[..., 2]
    return sets.of_color.at[color].get(mode="clip").astype(jnp.int32)


_COORDINATE_LIMIT = 2.0**20
"""Bound to which coordinates are clipped, far beyond any descriptor, so that their hundredths fit into int32."""


def strip_births(config: DescriptorConfig) -> jax.Array:
    """Return the filtration values at which the strips' vertices enter, j * sigma_2: [J] float32, scaled units."""
    # NumPy computes the product: XLA may fuse it with a sum, and programs would differ in the last bit.
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
        config: settings of the descriptor. Static.

    Returns:
        Two [N] int32 arrays. Numbers may lie outside the descriptor; the numbers of padding are meaningless.
    """
    if config.convention == "paper":
        return jnp.floor(z / config.sigma_1).astype(jnp.int32), jnp.floor(x / config.sigma_2).astype(jnp.int32)
    # After rounding to 0.01, x is k / 100. The first edge j / 40 at or above x has j = ceil(2 k / 5), in integers.
    strip = (2 * _round_scaled(jnp.clip(x, -_COORDINATE_LIMIT, _COORDINATE_LIMIT), 100).astype(jnp.int32) + 4) // 5
    level = _round_scaled(z, 10).astype(jnp.int32)
    # Levels below 0, and from twice the number of slices on, are outside the descriptor and are not renumbered.
    n_levels = 2 * config.n_slices
    ranked = (level >= 0) & (level < n_levels)
    occurs = jnp.zeros(n_levels, jnp.int32).at[jnp.where(mask & ranked, level, n_levels)].set(1, mode="drop")
    rank = jnp.cumsum(occurs) - 1
    return jnp.where(ranked, rank[jnp.clip(level, 0, n_levels - 1)], level), strip


def _extremes(y: jax.Array, segment: jax.Array, n_segments: int) -> tuple[jax.Array, jax.Array]:
    """Return the smallest and the largest `y` [N] of each segment, [n_segments] each; inf and -inf if it is empty.

    Points whose segment number is `n_segments` or more are dropped. Tied points share the gradient of an extreme.
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
        colors: [N, 3] sRGB in [0, 1]; used only with a relaxation.
        mask: [N] bool.
        region_set: [N] int32, row of `sets.weights` for each point, as `color_sets` returns it.
        sets: the region sets of the colour network.
        config: settings of the descriptor. Static.
    """
    n_segments = config.n_slices * config.n_strips
    x, y, z = points
    i, j = slices_and_strips(x, z, mask, config)
    # NaN and infinity must be excluded, since they would be converted to valid slice and strip numbers.
    inside = mask & jnp.isfinite(x) & jnp.isfinite(y) & jnp.isfinite(z)
    inside &= (i >= 0) & (i < config.n_slices) & (j >= 0) & (j < config.n_strips)
    overflow = (mask & ~inside).sum(dtype=jnp.int32)
    if config.relaxation is not None:
        relaxed = relaxed_strips(points, colors, mask, sets, config)
        return dataclasses.replace(relaxed, overflow=overflow)

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
    # Points are counted by region set first, which needs one addition per point instead of one per point and region.
    n_sets = sets.weights.shape[0]
    cell = segment * n_sets + region_set
    counts = jnp.zeros(n_segments * n_sets, jnp.float32).at[cell].add(1, mode="drop")
    return matmul(counts.reshape(n_segments, n_sets), sets.weights)


def _released_values(strips: Strips) -> Strips:
    """Round the extremes of y to 0.01 and divide each colour vector by its strip's number of points."""
    # Rounding keeps the order of numbers, so the extremes of rounded coordinates are the rounded extremes.
    low, high = (_round_scaled(y, 100) / 100 for y in (strips.low, strips.high))
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


_OFFSETS = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
"""[27, 3] offsets, in levels, from the nearest grid colour to itself and its neighbours."""

_WEIGHT_FLOOR = 1e-3
"""Floor of the weights in a strip's mean, which keeps the quotient bounded; for smaller weights the mean tends to 0."""


def interval_log_weights(coordinates: jax.Array, width: float, count: int, temperature: float) -> jax.Array:
    """Return the logarithms of the weights of coordinates in consecutive intervals that start at 0.

    A weight is sigmoid((x - lower) / T) - sigmoid((x - upper) / T). The first interval has no lower bound, since
    aligned clouds touch 0, and a point on that border belongs to no other interval.

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
    # A product instead of the difference loses no digits where both sigmoids are nearly equal.
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
    sets: RegionSets,
    config: DescriptorConfig,
    point_weights: jax.Array | None = None,
) -> Strips:
    """Return the soft extremes and the colour vector of every strip of one aligned cloud (no batch axis).

    Let w be the weight of a point in a strip and m the mean of y with the weights w^2. The upper extreme is
    m + T log(1 + sum w (exp(w (y - m) / T) - 1)), and the lower one is computed likewise. Deviations are multiplied by
    w, too; otherwise a point high up in the next strip would dominate at any temperature despite its small weight. A
    strip with little weight or only one point has little persistence and vanishes from the image.

    Args:
        points: [3, N], scaled units; points with a negative x or z are ignored, as in hard slices.
        colors: [N, 3] sRGB in [0, 1].
        mask: [N] bool.
        sets: region sets of the colour network.
        config: its `relaxation` gives the temperatures. Static.
        point_weights: [N] float32 from 0 to 1, weight of each point; a point of weight 0 is left out. By default all
            weights are 1. Gradients of the weights attribute an answer to points (`explanation.attributions`).

    Returns:
        Strips; a strip is occupied if any point has a positive weight in it. Their overflow is 0: `strips_of_cloud`
        counts that of the hard slices.
    """
    relaxation = config.relaxation or Relaxation()
    x, y, z = points
    counted = (mask & (x >= 0) & (z >= 0))[:, None]
    log_slice = interval_log_weights(z, config.sigma_1, config.n_slices, relaxation.slice)
    log_strip = interval_log_weights(x, config.sigma_2, config.n_strips, relaxation.strip)
    regions = soft_regions(colors, sets, relaxation.color)

    # With a checkpoint, the gradient recomputes the [N, J] arrays of each slice instead of storing them for all slices.
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
        return low, high, (weight > 0).any(axis=0), matmul(weight.T, regions)

    low, high, occupied, color = jax.lax.map(one_slice, log_slice.T)
    return Strips(low, high, occupied, color, jnp.zeros((), jnp.int32))


def square_root(values: jax.Array) -> jax.Array:
    """Return the square roots of values; 0 with a gradient of 0 where a value is not positive."""
    positive = values > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, values, 1)), 0)


_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Matrix from linear sRGB to XYZ, as rounded in IEC 61966-2-1."""

_WHITE = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
"""XYZ of D65, the white point of the colour grid (`colornet.colors.GRID_WHITE`)."""


def to_lab(colors: jax.Array) -> jax.Array:
    """Convert sRGB colours in [0, 1] to CIELAB (D65): [..., 3] to [..., 3], L* in 0..100."""
    dark = colors <= 0.04045
    linear = jnp.where(dark, colors / 12.92, ((jnp.where(dark, 1, colors) + 0.055) / 1.055) ** 2.4)
    xyz = matmul(linear, jnp.asarray((_TO_XYZ / _WHITE[:, None]).T, linear.dtype))
    small = xyz <= (6 / 29) ** 3
    root = jnp.where(small, xyz * (29 / 6) ** 2 / 3 + 4 / 29, jnp.cbrt(jnp.where(small, 1, xyz)))
    fx, fy, fz = root[..., 0], root[..., 1], root[..., 2]
    return jnp.stack([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)], axis=-1)


def _hyab(first: jax.Array, second: jax.Array) -> jax.Array:
    """Return the HyAB difference |dL*| + sqrt(da*^2 + db*^2), [..., 3] to [...]; its gradient is 0 at equal colours."""
    difference = first - second
    return jnp.abs(difference[..., 0]) + square_root((difference[..., 1:] ** 2).sum(axis=-1))


@functools.cache
def _grid_lab() -> jax.Array:
    with jax.ensure_compile_time_eval():
        return to_lab(jnp.asarray(grid_colors() / 255, jnp.float32))


def soft_regions(colors: jax.Array, sets: RegionSets, temperature: float) -> jax.Array:
    """Return region weights of colours, averaged over nearby grid colours by a softmax over HyAB distances.

    The 27 grid colours within one level of the nearest one have weights in proportion to exp(-HyAB / T) times a factor.
    This factor decreases to 0 where a channel is 1/2 + T / (1 + T) levels away, so that the weights are continuous
    where the nearest grid colour changes. As the temperature approaches zero, only the colour that is nearest in every
    channel remains, as in the hard rule; the nearest colour by HyAB may be another one.

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
    # The nearest colour is always included; at a tiny temperature, rounding could exclude it.
    chosen = exists & ((closeness > 0).all(axis=-1) | ~_OFFSETS.any(axis=-1))
    fade = 2 * jnp.log(jnp.where(closeness > 0, closeness, 1e-7)).sum(axis=-1)
    distance = _hyab(to_lab(colors)[:, None], _grid_lab()[row])
    share = jax.nn.softmax(jnp.where(chosen, fade - distance / temperature, -jnp.inf), axis=-1)

    # Weights are summed by region set first: [N, 62] instead of [N, 27, 22].
    by_set = jnp.zeros((len(colors), sets.weights.shape[0]), share.dtype)
    by_set = by_set.at[jnp.arange(len(colors))[:, None], sets.of_color[row]].add(share)
    return matmul(by_set, sets.weights)
