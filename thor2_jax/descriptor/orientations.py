"""Candidate orientations: the frames of axes that the view normalization chooses between by small differences.

A view's end with more points, and the longer of two nearly equal sides, may differ from those of the next view.
Recognition describes and classifies K orientations of each cloud and fuses the answers, so that they do not depend on
these choices. K = 1 is the paper.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from colornet import ColorNetwork
from thor2_jax.config import ORIENTATION_COUNTS, DescriptorConfig
from thor2_jax.descriptor.chunking import map_large_chunks
from thor2_jax.descriptor.cloud_statistics import cloud_statistics, side_lengths
from thor2_jax.descriptor.describe import describe_strips, strips
from thor2_jax.descriptor.view_normalization import Normalization, align, boxed, oriented, place_aligned
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors, PointClouds, Strips

__all__ = [
    "NEARLY_EQUAL",
    "OrientedDescriptors",
    "candidate_orientations",
    "describe_orientations",
    "orient_descriptors",
]

NEARLY_EQUAL = 0.85
"""Least ratio of a side of the box to the next longer one at which the two may be swapped."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class OrientedDescriptors:
    """The descriptors of B clouds in K candidate orientations.

    Attributes:
        each: descriptors, fields [B, K, ...].
        statistics: [B, K, 12 + R] float32, from `cloud_statistics`.
        weights: [B, K] float32, weight of each orientation in the fused answer; they sum to 1.
    """

    each: Descriptors
    statistics: jax.Array
    weights: jax.Array

    @property
    def first(self) -> Descriptors:
        """The descriptors [B, ...] of the paper's orientation."""
        first: Descriptors = jax.tree.map(lambda a: a[:, 0], self.each)
        return first

    @property
    def overflow(self) -> jax.Array:
        """The overflow [B] of the descriptors in the paper's orientation."""
        return self.each.overflow[:, 0]

    def fuse(self, logits: jax.Array) -> jax.Array:
        """Return class probabilities [B, n] from the logits [B * K, n] of `flat`.

        They are the geometric mean over the orientations, by their weights, normalized to sum to 1.
        """
        each = jax.nn.log_softmax(logits).reshape(*self.weights.shape, -1)
        return jax.nn.softmax((self.weights[..., None] * each).sum(axis=1))

    @property
    def flat(self) -> tuple[Descriptors, jax.Array]:
        """The descriptors [B * K, ...] and statistics [B * K, 12 + R]; those of a cloud are consecutive."""
        flat: tuple[Descriptors, jax.Array] = jax.tree.map(
            lambda a: a.reshape(-1, *a.shape[2:]), (self.each, self.statistics)
        )
        return flat


def _swapped(normalization: Normalization) -> Normalization:
    """Swap the first two axes of a box whose first two sides are nearly equal."""
    sides = normalization.high - normalization.low
    order = jnp.where(sides[1] > NEARLY_EQUAL * sides[0], jnp.array([1, 0, 2]), jnp.arange(3))
    return normalization._replace(
        axes=normalization.axes[order], low=normalization.low[order], high=normalization.high[order]
    )


def _check_count(count: int) -> None:
    if count not in ORIENTATION_COUNTS:
        raise InputError(f"count is {count!r}; expected one of {', '.join(map(str, ORIENTATION_COUNTS))}")


@partial(jax.jit, static_argnums=(1, 2))
def _orientations(clouds: PointClouds, config: DescriptorConfig, count: int) -> tuple[PointClouds, jax.Array]:
    half_turn = jnp.diag(jnp.array([-1, -1, 1], jnp.float32))

    def one(cloud: PointClouds) -> tuple[jax.Array, jax.Array, jax.Array]:
        normalization = boxed(cloud, np.float32(config.sigma_s))
        rotations, weights = [], []
        for box in (normalization, _swapped(normalization))[: count // 2]:
            rotation, end_is_occluded = oriented(box)
            rotations += [rotation, half_turn @ rotation]
            weights += [jnp.ones(()), jnp.where(end_is_occluded, 0.0, 1.0)]
        placed = [place_aligned(rotation, normalization, np.float32(config.alpha)) for rotation in rotations]
        points, cameras = zip(*placed, strict=True)
        return jnp.stack(points)[:, : len(cloud.mask)], jnp.stack(cameras), jnp.stack(weights)

    points, cameras, weights = jax.vmap(one)(clouds)
    repeated = jax.tree.map(lambda array: jnp.repeat(array, count, axis=0), clouds)
    flat = (array.reshape(-1, *array.shape[2:]) for array in (points, cameras))
    aligned = dataclasses.replace(repeated, **dict(zip(("points", "camera"), flat, strict=True)))
    return aligned, weights / weights.sum(axis=1, keepdims=True)


def candidate_orientations(clouds: PointClouds, config: DescriptorConfig, count: int) -> tuple[PointClouds, jax.Array]:
    """Return `count` aligned versions of each cloud, the one of `align` first, and their weights.

    With 2, the other one is turned by half a turn about z before the turn by alpha. With 4, both are repeated with the
    first two sides of the box swapped if they are nearly equal, and unchanged otherwise. A half turn has no weight
    where the occlusion boundary decides which end comes first; all other weights of a cloud are equal.

    Args:
        clouds: [B, N] clouds in metres.
        config: only `sigma_s` and `alpha` are used. Static.
        count: one of `ORIENTATION_COUNTS`. Static.

    Returns:
        [B * count, N] aligned clouds in scaled units, those of a cloud consecutive, and weights [B, count], which sum
        to 1 for each cloud.

    Raises:
        InputError: `count` is another number.
    """
    _check_count(count)
    if count == 1:
        return align(clouds, config), jnp.ones((len(clouds.mask), 1))
    return _orientations(clouds, config, count)


def orient_descriptors(
    aligned: PointClouds, weights: jax.Array, strips: Strips, network: ColorNetwork, config: DescriptorConfig
) -> OrientedDescriptors:
    """Return the descriptors of the orientations of clouds.

    Args:
        aligned: [B * K, N] clouds, from `candidate_orientations`.
        weights: [B, K] float32, likewise.
        strips: their strips.
        network: colour network.
        config: static.
    """
    return _group_by_cloud(describe_strips(strips, network, config), aligned, weights, strips, config)


@partial(jax.jit, static_argnums=4)
def _group_by_cloud(
    descriptors: Descriptors, aligned: PointClouds, weights: jax.Array, strips: Strips, config: DescriptorConfig
) -> OrientedDescriptors:
    """Group the descriptors [B * K, ...] of orientations by cloud, and add the statistics of the clouds."""
    shape = weights.shape
    each = jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), descriptors)
    # The side lengths and the colours of all orientations are equal.
    first, first_strips = jax.tree.map(lambda a: a[:: shape[1]], (aligned, strips))
    statistics = cloud_statistics(side_lengths(first, config.alpha), first, first_strips)
    return OrientedDescriptors(each, jnp.repeat(statistics[:, None], shape[1], axis=1), weights)


def describe_orientations(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, count: int | None = None
) -> OrientedDescriptors:
    """Return the descriptors of the candidate orientations of clouds.

    Args:
        clouds: [B, N] clouds in metres.
        network: colour network.
        config: static.
        count: number of orientations K; by default `config.orientations`. Static.

    Raises:
        InputError: `count` is not one of `ORIENTATION_COUNTS`.
    """
    count = config.orientations if count is None else count
    _check_count(count)

    def describe_chunk(chunk: PointClouds) -> OrientedDescriptors:
        aligned, weights = candidate_orientations(chunk, config, count)
        return orient_descriptors(aligned, weights, strips(aligned, network, config, count), network, config)

    return map_large_chunks(describe_chunk, clouds, count)
