"""CIELAB on the device."""

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.descriptor.bounding_box import HIGHEST

__all__ = ["to_lab"]

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
