"""Augmentation of orientation: normalized clouds with other axes, as the normalization might choose in another view.

Which of two nearly equal sides is longer, and which end has more points, differs between cameras. The axes of the box
also have errors of some degrees.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thor2_jax.types import PointClouds

__all__ = ["reorient"]

NEARLY_EQUAL = 0.85
"""Smallest ratio of a side of the box to the next longer side at which the two may be swapped."""

MAX_ROTATION = 10.0
"""Largest random rotation of a normalized cloud, degrees."""


@jax.jit
def _reoriented(normal: PointClouds, axes: jax.Array, mirrored: jax.Array) -> PointClouds:
    """Rotate normalized clouds to axes [B, 3, 3], then mirror those in `mirrored` [B] in x; the camera stays at -z."""

    def one(cloud: PointClouds, axes: jax.Array, mirrored: jax.Array) -> PointClouds:
        inside = cloud.mask[:, None]
        middle = cloud.points.max(axis=0) / 2
        points, camera = (jnp.matmul(a - middle, axes.T) for a in (cloud.points, cloud.camera))
        low = jnp.where(inside, points, jnp.inf).min(axis=0)
        high = jnp.where(inside, points, -jnp.inf).max(axis=0)
        signs = jnp.stack([mirrored, jnp.zeros_like(mirrored), camera[2] > (low[2] + high[2]) / 2])
        corner = jnp.where(signs, high, low)
        corner = jnp.where(jnp.isfinite(corner), corner, 0)
        sign = jnp.where(signs, -1, 1)
        points = jnp.where(inside, sign * (points - corner), 0)
        return dataclasses.replace(cloud, points=points, camera=sign * (camera - corner))

    return jax.vmap(one)(normal, axes, mirrored)


def _random_axes(sides: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return axes [B, 3, 3] after swaps of nearly equal sides [B, 3] and a small rotation about a random axis."""
    sides, axes = sides.copy(), np.tile(np.eye(3), (len(sides), 1, 1))
    for order, (i, j) in (([1, 0, 2], (0, 1)), ([0, 2, 1], (1, 2))):
        swap = (sides[:, j] > NEARLY_EQUAL * sides[:, i]) & (rng.random(len(sides)) < 0.5)
        sides[swap], axes[swap] = sides[swap][:, order], axes[swap][:, order]
    direction = rng.standard_normal((len(sides), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    angle = np.radians(rng.uniform(0, MAX_ROTATION, (len(sides), 1)))
    return np.asarray(Rotation.from_rotvec(angle * direction).as_matrix() @ axes, np.float32)


def reorient(normal: PointClouds, rng: np.random.Generator) -> PointClouds:
    """Return normalized clouds [B, N] in random orientations.

    In half of the clouds, two neighbouring sides of the box that are nearly equal are swapped. Each cloud is rotated by
    up to 10 degrees about a random axis. Half of the clouds are mirrored in x, which has the same effect on the
    descriptor as a half turn about z.

    Args:
        normal: clouds as returned by `view_normalize`.
        rng: random number generator for the orientations.
    """
    axes = _random_axes(np.asarray(normal.points.max(axis=1)), rng)
    oriented: PointClouds = _reoriented(normal, axes, rng.random(len(axes)) < 0.5)
    return oriented
