"""Looks: several ways to see one instance, whose answers are fused so that they depend less on any one of them.

The view normalization chooses between two half turns by small differences, masks reach over the edges of their objects,
and cameras differ in colour. Recognition therefore describes and classifies K looks at each cloud:

- 1: as it is, which is the paper;
- 2: also after a half turn about z;
- 4: as it is; after a half turn, without the points near the contour of its mask (`PointClouds.rim`); after a half
  turn, with warmer colours; and with cooler colours.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from colornet import ColorNetwork
from thor2_jax.config import LOOK_COUNTS, DescriptorConfig
from thor2_jax.descriptor.cloud_statistics import N_BALANCED, balanced_histogram, cloud_statistics, side_lengths
from thor2_jax.descriptor.describe import describe_strips, map_chunks, map_large_chunks, strips
from thor2_jax.descriptor.view_normalization import align, normalization_of, place_aligned
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors, PointClouds, Strips

__all__ = ["WARMTH", "LookDescriptors", "aligned_looks", "describe_aligned_looks", "describe_looks"]

WARMTH = 1.06
"""Factor of red, and divisor of blue, of the warmer look; the inverse of the cooler one."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class LookDescriptors:
    """The descriptors of K looks at each of B clouds.

    Attributes:
        each: descriptors, fields [B, K, ...].
        statistics: [B, K, 12 + R] float32, from `cloud_statistics`; `with_balanced` appends `N_BALANCED` values.
    """

    each: Descriptors
    statistics: jax.Array

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of clouds and of looks, (B, K)."""
        return self.each.overflow.shape

    @property
    def first(self) -> Descriptors:
        """The descriptors [B, ...] of the first look, the paper's."""
        return jax.tree.map(lambda a: a[:, 0], self.each)

    @property
    def overflow(self) -> jax.Array:
        """The overflow [B] of the descriptors of the first look."""
        return self.each.overflow[:, 0]

    def fuse(self, logits: jax.Array) -> jax.Array:
        """Return class probabilities [B, n] from the logits [B * K, n] of `flat`.

        They are the geometric mean over the looks, normalized to sum to 1.
        """
        return jax.nn.softmax(jax.nn.log_softmax(logits).reshape(*self.shape, -1).mean(axis=1))

    @property
    def flat(self) -> tuple[Descriptors, jax.Array]:
        """The descriptors [B * K, ...] and statistics [B * K, 12 + R]; those of a cloud are consecutive."""
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), (self.each, self.statistics))

    @jax.jit
    def with_balanced(self, clouds: PointClouds) -> "LookDescriptors":
        """Return descriptors whose statistics end with the `balanced_histogram` of the first look, for a gallery.

        Args:
            clouds: [B, N] the clouds, in metres or aligned.
        """
        histogram = map_chunks(lambda chunk: balanced_histogram(chunk.colors, chunk.mask), clouds)
        repeated = jnp.broadcast_to(histogram[:, None], (*self.shape, N_BALANCED))
        return dataclasses.replace(self, statistics=jnp.concatenate([self.statistics, repeated], axis=-1))


@partial(jax.jit, static_argnums=3)
def _looks(clouds: PointClouds, sigma_s: ArrayLike, alpha: ArrayLike, count: int) -> PointClouds:
    half_turn = jnp.diag(jnp.array([-1, -1, 1], jnp.float32))
    warmer = jnp.array([WARMTH, 1, 1 / WARMTH], jnp.float32)

    def placed(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
        """Return points [2, N, 3] and cameras [2, 3], as they are and after a half turn."""
        normalization = normalization_of(cloud, sigma_s)
        rotation = normalization.rotation
        # Where the occlusion boundary decides which end comes first, there is no half turn.
        both = jnp.stack([rotation, jnp.where(normalization.end_is_occluded, rotation, half_turn @ rotation)])
        return jax.vmap(lambda each: place_aligned(each, normalization, alpha))(both)

    masks, colors = [clouds.mask], clouds.colors
    looks = [(0, 0, colors), (0, 1, colors)]  # number of the mask, half turn, colours
    if count == 4:
        masks += [] if clouds.rim is None else [clouds.mask & ~clouds.rim]
        warm, cool = (colors * warmer).clip(0, 1), (colors / warmer).clip(0, 1)
        looks[1:] = (len(masks) - 1, 1, colors), (0, 1, warm), (0, 0, cool)
    # One batch of all masks: tracing takes a fourth longer for a further `vmap` over the masks.
    masked = [dataclasses.replace(clouds, mask=mask, rim=None) for mask in masks]
    batch = jax.tree.map(lambda *a: jnp.concatenate(a), *masked)
    n_clouds, n_points = clouds.mask.shape
    points, cameras = (a.reshape(len(masks), n_clouds, *a.shape[1:]) for a in jax.vmap(placed)(batch))
    rows = [
        dataclasses.replace(masked[m], points=points[m, :, k, :n_points], camera=cameras[m, :, k], colors=color)
        for m, k, color in looks
    ]
    return jax.tree.map(lambda *a: jnp.stack(a, axis=1).reshape(-1, *a[0].shape[1:]), *rows)


def aligned_looks(clouds: PointClouds, config: DescriptorConfig, count: int) -> PointClouds:
    """Return the aligned clouds of `count` looks at each cloud, that of `align` first.

    A half turn is left out where the occlusion boundary decides which end comes first.

    Args:
        clouds: [B, N] clouds in metres.
        config: only `sigma_s` and `alpha` are used; other values of them do not compile again.
        count: K, one of `LOOK_COUNTS`. Static.

    Returns:
        [B * K, N] aligned clouds in scaled units, those of a cloud consecutive.

    Raises:
        InputError: `count` is none of `LOOK_COUNTS`.
    """
    if count not in LOOK_COUNTS:
        raise InputError(f"count is {count!r}; expected one of {', '.join(map(str, LOOK_COUNTS))}")
    if count == 1:
        return align(clouds, config)
    return _looks(clouds, np.float32(config.sigma_s), np.float32(config.alpha), count)


def describe_aligned_looks(
    aligned: PointClouds, strips: Strips, network: ColorNetwork, config: DescriptorConfig, count: int
) -> LookDescriptors:
    """Return the descriptors of looks.

    Args:
        aligned: [B * K, N] clouds, from `aligned_looks`.
        strips: their strips.
        network: colour network.
        config: static.
        count: K. Static.
    """
    return _group_by_cloud(describe_strips(strips, network, config), aligned, strips, config, count)


@partial(jax.jit, static_argnums=(3, 4))
def _group_by_cloud(
    descriptors: Descriptors, aligned: PointClouds, strips: Strips, config: DescriptorConfig, count: int
) -> LookDescriptors:
    """Group the descriptors [B * K, ...] of looks by cloud, and add the statistics of the clouds."""
    statistics = cloud_statistics(side_lengths(aligned, config.alpha), aligned, strips)
    return LookDescriptors(*jax.tree.map(lambda a: a.reshape(-1, count, *a.shape[1:]), (descriptors, statistics)))


def describe_looks(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, count: int | None = None
) -> LookDescriptors:
    """Return the descriptors of the looks at clouds.

    Args:
        clouds: [B, N] clouds in metres.
        network: colour network.
        config: static.
        count: number of looks K, one of `LOOK_COUNTS`; by default `config.looks`. Static.

    Raises:
        InputError: as `aligned_looks`.
    """
    count = config.looks if count is None else count

    def describe_chunk(chunk: PointClouds) -> LookDescriptors:
        aligned = aligned_looks(chunk, config, count)
        return describe_aligned_looks(aligned, strips(aligned, network, config), network, config, count)

    return map_large_chunks(describe_chunk, clouds, count)
