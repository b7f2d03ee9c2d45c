"""Statistics of a cloud that a network reads beside the descriptor: side lengths, number of points, colours."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from thor2_jax.types import PointClouds, Strips

__all__ = ["N_SCALARS", "cloud_statistics", "is_color", "side_lengths", "square_root"]

N_SCALARS = 12
"""Statistics of a cloud before its colour histogram."""

_COLOR_SCALARS = slice(5, 11)
"""Mean and standard deviation of the colours."""


def is_color(n_regions: int) -> NDArray[np.bool_]:
    """Return which of the statistics [12 + R] are of colours only."""
    result = np.arange(N_SCALARS + n_regions) >= N_SCALARS
    result[_COLOR_SCALARS] = True
    return result


@partial(jax.jit, static_argnums=1)
def side_lengths(aligned: PointClouds, alpha: float) -> jax.Array:
    """Return the side lengths [B, 3] of the boxes of aligned clouds before the turn by alpha, longest first."""
    c, s = np.float32(np.cos(alpha)), np.float32(np.sin(alpha))
    x, y, z = jnp.moveaxis(aligned.points, -1, 0)
    sides = []
    for values in (c * x + s * z, y, c * z - s * x):
        high = jnp.where(aligned.mask, values, -jnp.inf).max(axis=1)
        sides.append(high - jnp.where(aligned.mask, values, jnp.inf).min(axis=1))
    lengths = jnp.stack(sides, axis=1)
    return -jnp.sort(-jnp.where(jnp.isfinite(lengths), lengths, 0), axis=1)


def square_root(values: jax.Array) -> jax.Array:
    """Return the square roots of values; 0, with a gradient of 0, of those that are not positive."""
    positive = values > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, values, 1)), 0)


@jax.jit
def cloud_statistics(sides: jax.Array, clouds: PointClouds, strips: Strips) -> jax.Array:
    """Return statistics of clouds, all of order 1.

    Args:
        sides: [B, 3] side lengths of the bounding box, longest first, scaled units.
        clouds: [B, N] clouds, of which only colours and mask are used.
        strips: their strips; the colour vectors give the number of points in each colour region.

    Returns:
        [B, 12 + R] float32: side lengths, size of the box, number of points, mean and standard deviation of the
        colours, ratio of the two longest sides, and the square root of the colour histogram, which has unit length.
    """
    count = clouds.mask.sum(axis=1, keepdims=True, dtype=jnp.float32)
    weight = clouds.mask[..., None].astype(jnp.float32) / jnp.maximum(count, 1)[..., None]
    mean = (clouds.colors * weight).sum(axis=1)
    deviation = square_root((jnp.square(clouds.colors) * weight).sum(axis=1) - jnp.square(mean))
    scalars = [
        2 * sides,
        3 * jnp.cbrt(sides.prod(axis=1, keepdims=True)),
        jnp.sqrt(count) / 20,
        mean,
        deviation,
        sides[:, 1:2] / jnp.maximum(sides[:, :1], 1e-6),
    ]
    region_points = strips.color.sum(axis=(1, 2))
    histogram = region_points / jnp.maximum(region_points.sum(axis=1, keepdims=True), 1e-6)
    return jnp.concatenate([*scalars, square_root(histogram)], axis=1)
