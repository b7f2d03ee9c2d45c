"""Looks: several versions of one instance, whose answers are fused so that the result depends less on any of them.

Small differences decide about half turns in the view normalization, masks extend past the edges of their objects, and
cameras differ in colour. Recognition therefore describes and classifies K looks at each cloud:

- 1: the cloud as it is, as in the paper;
- 2: also after a half turn about z;
- 4: as it is; after a half turn, without the points near the contour of its mask (`PointClouds.rim`); after a half
  turn, with warmer colours; and with cooler colours.

Beside the descriptor of a look, networks read statistics of its cloud: side lengths, number of points, colours. The
histogram of balanced colours among them is only for galleries. It is finer than the colour regions of the network, so
that objects of one shape with different prints differ, and depends less on the light.
"""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import LOOK_COUNTS, DescriptorConfig
from thor2_jax.descriptor.describe import describe_strips, map_chunks, map_large_chunks, strips
from thor2_jax.descriptor.slicing import square_root, to_lab
from thor2_jax.descriptor.view_normalization import align, normalization_of, place_aligned
from thor2_jax.errors import InputError
from thor2_jax.types import HIGHEST, Descriptors, PointClouds, Strips

__all__ = [
    "N_BALANCED",
    "N_SCALARS",
    "LookDescriptors",
    "aligned_looks",
    "balanced_histogram",
    "cloud_statistics",
    "describe_aligned_looks",
    "describe_looks",
    "is_color",
]

WARMTH = 1.06
"""Factor of red and divisor of blue in the warmer look; the cooler look has the inverse."""

N_SCALARS = 12
"""Number of statistics of a cloud before its colour histogram."""

_BINS = 6, 7, 7
"""Numbers of bins of L*, a* and b* in the balanced histogram."""

N_BALANCED = int(np.prod(_BINS))
"""Number of bins of the balanced histogram."""

_CHROMA, _MAX_CHROMA = 10, 60
"""Bins of a* and b* end at `_MAX_CHROMA`; they are narrow below `_CHROMA`, where most surfaces are."""

_BALANCE = 0.45
"""Mean of a channel that the balance does not change."""

_COLOR_SCALARS = slice(5, 11)
"""Indices of the mean and the standard deviation of the colours."""


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
        """The descriptors [B, ...] of the first look, which are those of the paper."""
        return jax.tree.map(lambda a: a[:, 0], self.each)

    @property
    def overflow(self) -> jax.Array:
        """The overflow [B] of the descriptors of the first look."""
        return self.each.overflow[:, 0]

    def fuse(self, logits: jax.Array) -> jax.Array:
        """Return class probabilities [B, n] from the logits [B * K, n] of `flat`.

        The probabilities are the geometric mean over the looks, normalized to sum to 1.
        """
        return jax.nn.softmax(jax.nn.log_softmax(logits).reshape(*self.shape, -1).mean(axis=1))

    @property
    def flat(self) -> tuple[Descriptors, jax.Array]:
        """The descriptors [B * K, ...] and statistics [B * K, 12 + R]; the looks at a cloud are consecutive."""
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
    half_turn = jnp.array([[-1], [-1], [1]], jnp.float32)
    warmer = jnp.array([WARMTH, 1, 1 / WARMTH], jnp.float32)

    def placed(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
        """Return points [2, N, 3] and cameras [2, 3], without and with a half turn."""
        normalization = normalization_of(cloud, sigma_s)
        rotation = normalization.rotation
        # If the occlusion boundary decides which end comes first, there is no half turn.
        both = jnp.stack([rotation, jnp.where(normalization.end_is_occluded, rotation, half_turn * rotation)])
        return jax.vmap(lambda each: place_aligned(each, normalization, alpha))(both)

    masks, colors = [clouds.mask], clouds.colors
    looks = [(0, 0, colors), (0, 1, colors)]  # number of the mask, half turn, colours
    if count == 4:
        masks += [] if clouds.rim is None else [clouds.mask & ~clouds.rim]
        warm, cool = (colors * warmer).clip(0, 1), (colors / warmer).clip(0, 1)
        looks[1:] = (len(masks) - 1, 1, colors), (0, 1, warm), (0, 0, cool)
    # All masks are one batch, since tracing takes a fourth longer with a further `vmap` over the masks.
    masked = [dataclasses.replace(clouds, mask=mask, rim=None, around=None) for mask in masks]
    batch = jax.tree.map(lambda *a: jnp.concatenate(a), *masked)
    n_clouds, n_points = clouds.mask.shape
    points, cameras = (a.reshape(len(masks), n_clouds, *a.shape[1:]) for a in jax.vmap(placed)(batch))
    rows = [
        dataclasses.replace(masked[m], points=points[m, :, k, :n_points], camera=cameras[m, :, k], colors=color)
        for m, k, color in looks
    ]
    return jax.tree.map(lambda *a: jnp.stack(a, axis=1).reshape(-1, *a[0].shape[1:]), *rows)


def aligned_looks(clouds: PointClouds, config: DescriptorConfig, count: int) -> PointClouds:
    """Return the aligned clouds of `count` looks at each cloud; the first one is the result of `align`.

    There is no half turn if the occlusion boundary decides which end comes first.

    Args:
        clouds: [B, N] clouds in metres.
        config: only `sigma_s` and `alpha` are used; changing them does not cause a compilation.
        count: K, one of `LOOK_COUNTS`. Static.

    Returns:
        [B * K, N] aligned clouds in scaled units; the looks at a cloud are consecutive.

    Raises:
        InputError: `count` is not in `LOOK_COUNTS`.
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
        strips: strips of the clouds.
        network: colour network.
        config: settings of the descriptor. Static.
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
        config: settings of the descriptor. Static.
        count: number of looks K, one of `LOOK_COUNTS`; by default `config.looks`. Static.

    Raises:
        InputError: as `aligned_looks`.
    """
    count = config.looks if count is None else count

    def describe_chunk(chunk: PointClouds) -> LookDescriptors:
        aligned = aligned_looks(chunk, config, count)
        return describe_aligned_looks(aligned, strips(aligned, network, config), network, config, count)

    return map_large_chunks(describe_chunk, clouds, count)


def is_color(n_regions: int) -> NDArray[np.bool_]:
    """Return which of the statistics [12 + R] depend on colours only."""
    result = np.arange(N_SCALARS + n_regions) >= N_SCALARS
    result[_COLOR_SCALARS] = True
    return result


def before_turn(alpha: float, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
    """Return the coordinates of aligned points before the rotation by alpha."""
    c, s = np.float32(np.cos(alpha)), np.float32(np.sin(alpha))
    return c * x + s * z, y, c * z - s * x


@partial(jax.jit, static_argnums=1)
def side_lengths(aligned: PointClouds, alpha: float) -> jax.Array:
    """Return the side lengths [B, 3] of the boxes of aligned clouds before the rotation by alpha, longest first."""
    sides = []
    for values in before_turn(alpha, *jnp.moveaxis(aligned.points, -1, 0)):
        high = jnp.where(aligned.mask, values, -jnp.inf).max(axis=1)
        sides.append(high - jnp.where(aligned.mask, values, jnp.inf).min(axis=1))
    lengths = jnp.stack(sides, axis=1)
    return -jnp.sort(-jnp.where(jnp.isfinite(lengths), lengths, 0), axis=1)


@jax.jit
def cloud_statistics(sides: jax.Array, clouds: PointClouds, strips: Strips) -> jax.Array:
    """Return statistics of clouds, all of order 1.

    Args:
        sides: [B, 3] side lengths of the bounding box, longest first, scaled units.
        clouds: [B, N] clouds; only colours and mask are used.
        strips: strips of the clouds, whose colour vectors give the number of points in each colour region.

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
    """Return CIELAB histograms of clouds after half of the colour cast and of the exposure is removed.

    Each channel is divided by the square root of its mean, since division by the mean would make objects of one colour
    grey. A point is shared between neighbouring bins.

    Args:
        colors: [B, N, 3] sRGB in [0, 1].
        mask: [B, N] bool.

    Returns:
        [B, `N_BALANCED`] float32, the square roots of fractions that sum to 1; zeros for a cloud without points.
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
    joint = jnp.einsum("bnl,bna,bnc->blac", shares[0] * weight, *shares[1:], precision=HIGHEST)
    return square_root(joint.reshape(len(colors), -1))
