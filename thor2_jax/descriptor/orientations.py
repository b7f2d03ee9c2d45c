"""Candidate orientations: the frames of axes that the view normalization chooses between by small differences.

A view's end with more points, and the longer of two nearly equal sides, may differ from those of the next view. Scores
that are averaged over both choices do not depend on them.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import Normalization, boxed, oriented, place_aligned
from thor2_jax.errors import InputError
from thor2_jax.types import PointClouds

__all__ = ["ORIENTATION_COUNTS", "candidate_orientations"]

ORIENTATION_COUNTS = (1, 2, 4)
"""Numbers of candidate orientations; 1 is the paper's."""

NEARLY_EQUAL = 0.85
"""Least ratio of the second side of the box to the first at which the two are also swapped."""


def _swapped(normalization: Normalization) -> Normalization:
    """Swap the first two axes of a box whose first two sides are nearly equal."""
    sides = normalization.high - normalization.low
    order = jnp.where(sides[1] > NEARLY_EQUAL * sides[0], jnp.array([1, 0, 2]), jnp.arange(3))
    return normalization._replace(
        axes=normalization.axes[order], low=normalization.low[order], high=normalization.high[order]
    )


@partial(jax.jit, static_argnums=(1, 2))
def _orientations(clouds: PointClouds, config: DescriptorConfig, count: int) -> PointClouds:
    half_turn = jnp.diag(jnp.array([-1, -1, 1], jnp.float32))

    def one(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
        normalization = boxed(cloud, np.float32(config.sigma_s))
        rotations = []
        for box in (normalization, _swapped(normalization)):
            rotation = oriented(box)
            rotations += [rotation, half_turn @ rotation]
        placed = [place_aligned(rotation, normalization, np.float32(config.alpha)) for rotation in rotations[:count]]
        points, cameras = zip(*placed, strict=True)
        return jnp.stack(points)[:, : len(cloud.mask)], jnp.stack(cameras)

    points, cameras = jax.vmap(one)(clouds)
    repeated = jax.tree.map(lambda array: jnp.repeat(array, count, axis=0), clouds)
    flat = (array.reshape(-1, *array.shape[2:]) for array in (points, cameras))
    return dataclasses.replace(repeated, **dict(zip(("points", "camera"), flat, strict=True)))


def candidate_orientations(clouds: PointClouds, config: DescriptorConfig, count: int) -> PointClouds:
    """Return `count` aligned versions of each cloud, the one of `align` first.

    With 2, the other one is turned by half a turn about z before the turn by alpha. With 4, both are repeated with the
    first two sides of the box swapped if they are nearly equal, and unchanged otherwise.

    Args:
        clouds: [B, N] clouds in metres.
        config: only `sigma_s` and `alpha` are used. Static.
        count: one of `ORIENTATION_COUNTS`. Static.

    Returns:
        [B * count, N] aligned clouds in scaled units; those of a cloud are consecutive.

    Raises:
        InputError: `count` is another number.
    """
    if count not in ORIENTATION_COUNTS:
        raise InputError(f"count is {count!r}; expected one of {', '.join(map(str, ORIENTATION_COUNTS))}")
    return _orientations(clouds, config, count)
