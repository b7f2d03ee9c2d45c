"""Statistics of a cloud that a network reads beside the descriptor: side lengths, number of points, CIELAB colours.

The histogram of balanced colours is only for galleries. It is finer than the colour regions of the network, so that
objects of one shape with different prints differ, and depends less on the light.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from thor2_jax.descriptor.bounding_box import HIGHEST
from thor2_jax.types import PointClouds, Strips

__all__ = [
    "N_BALANCED",
    "N_SCALARS",
    "balanced_histogram",
    "cloud_statistics",
    "is_color",
    "side_lengths",
    "square_root",
    "to_lab",
]

_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""Matrix from linear sRGB to XYZ, as rounded in IEC 61966-2-1."""

_WHITE = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
"""XYZ of D65, the white point of the colour grid (`colornet.lab.GRID_WHITE`)."""


def to_lab(colors: jax.Array) -> jax.Array:
    """Convert sRGB colours in [0, 1] to CIELAB (D65): [..., 3] to [..., 3], L* in 0..100."""
    dark = colors <= 0.04045
    linear = jnp.where(dark, colors / 12.92, ((jnp.where(dark, 1, colors) + 0.055) / 1.055) ** 2.4)
    xyz = jnp.matmul(linear, jnp.asarray((_TO_XYZ / _WHITE[:, None]).T, linear.dtype), precision=HIGHEST)
    small = xyz <= (6 / 29) ** 3
    root = jnp.where(small, xyz * (29 / 6) ** 2 / 3 + 4 / 29, jnp.cbrt(jnp.where(small, 1, xyz)))
    fx, fy, fz = root[..., 0], root[..., 1], root[..., 2]
    return jnp.stack([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)], axis=-1)


N_SCALARS = 12
"""Statistics of a cloud before its colour histogram."""

_BINS = 6, 7, 7
"""Bins of lightness, a* and b* of the balanced histogram."""

N_BALANCED = int(np.prod(_BINS))
"""Bins of the balanced histogram."""

_CHROMA, _MAX_CHROMA = 10, 60
"""Bins of a* and b* end at `_MAX_CHROMA`; they are narrow below `_CHROMA`, where most surfaces are."""

_BALANCE = 0.45
"""Mean of each channel that the balance leaves as it is."""

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


@jax.jit
def balanced_histogram(colors: jax.Array, mask: jax.Array) -> jax.Array:
    """Return histograms of clouds in CIELAB, after half of the colour cast and of the exposure is taken out.

    Each channel is divided by the square root of its mean: with the whole of it, objects of one colour would be grey. A
    point belongs to neighbouring bins by shares.

    Args:
        colors: [B, N, 3] sRGB in [0, 1].
        mask: [B, N] bool.

    Returns:
        [B, `N_BALANCED`] float32, the square roots of shares that sum to 1; zeros for a cloud without points.
    """
    inside = mask[..., None].astype(jnp.float32)
    weight = inside / jnp.maximum(inside.sum(axis=1, keepdims=True), 1)
    mean = (colors * weight).sum(axis=1, keepdims=True)
    lab = to_lab((colors * jnp.sqrt(_BALANCE / (mean + 0.03))).clip(0, 1))
    chroma = jnp.arcsinh(lab[..., 1:] / _CHROMA) / np.arcsinh(_MAX_CHROMA / _CHROMA)
    place = jnp.concatenate([lab[..., :1] / 100, (chroma + 1) / 2], axis=-1).clip(0, 1)
    shares = [
        jnp.maximum(0, 1 - jnp.abs(place[..., k, None] * (n - 1) - jnp.arange(n, dtype=jnp.float32)))
        for k, n in enumerate(_BINS)
    ]
    joint = jnp.einsum("bnl,bna,bnc->blac", shares[0] * weight, *shares[1:])
    return square_root(joint.reshape(len(colors), -1))
