"""Persistence images (Adams et al. 2017; paper, section "TOPS"): a slice's diagram becomes a small picture."""

import jax
import jax.numpy as jnp
from jax.scipy.special import erf
from jax.typing import ArrayLike

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.slicing import strip_births
from thor2_jax.types import Diagrams

__all__ = ["past_window", "persistence_images"]


def _at_edges(centres: jax.Array, variance: ArrayLike, config: DescriptorConfig) -> jax.Array:
    """Twice the normal CDF about `centres` [..., J], less 1, at the edges of an axis' pixels: [..., P + 1, J]."""
    edges = (jnp.arange(config.image_size + 1) - 1) * config.sigma_2
    # A quarter of the cost of `ndtr`, which keeps far tails to more digits than an image has.
    return erf((edges.astype(centres.dtype)[:, None] - centres[..., None, :]) * jax.lax.rsqrt(2 * variance))


def _weight(persistence: jax.Array, exponent: ArrayLike) -> jax.Array:
    """persistence**exponent; 0 at 0, with a finite gradient for any exponent, and the number itself for 1."""
    return persistence * jnp.exp((exponent - 1) * jnp.log(jnp.where(persistence > 0, persistence, 1)))


def persistence_images(
    diagrams: Diagrams,
    config: DescriptorConfig,
    variance: ArrayLike | None = None,
    persistence_weight: ArrayLike | None = None,
) -> jax.Array:
    """Sum over the pairs of persistence**n x Gaussian, integrated over each pixel; the paper's n is 1.

    The Gaussian is separable, so an image is one product of two tables. The one for births is the same for all slices:
    pair j is born with strip j.

    Args:
        diagrams: of any number of slices, fields [..., J].
        config: static.
        variance: [], of the Gaussian; by default the config's `image_variance`.
        persistence_weight: [], the exponent n; by default the config's.

    Returns:
        [..., P, P] float32, axes birth and persistence, both over [-sigma_2, (P - 1) sigma_2]; zeros for an empty
        diagram.
    """
    persistence = jnp.where(diagrams.mask, diagrams.deaths - diagrams.births, 0)
    births = strip_births(config)
    # Whole vector registers of pairs.
    padding = -len(births) % 8
    persistence = jnp.pad(persistence, [(0, 0)] * (persistence.ndim - 1) + [(0, padding)])
    births = jnp.pad(births, (0, padding))
    variance = config.image_variance if variance is None else variance
    # No persistence, no weight: padding adds nothing.
    weight = _weight(persistence, config.persistence_weight if persistence_weight is None else persistence_weight)
    by_persistence = _at_edges(persistence, variance, config) * weight[..., None, :]
    by_birth = jnp.diff(_at_edges(births, variance, config), axis=-2)
    # Differences along persistence are taken of the product: before it, compilers make each edge's `erf` twice.
    images = jnp.diff(jnp.matmul(by_persistence, by_birth.T, precision=jax.lax.Precision.HIGHEST), axis=-2) / 4
    return jnp.swapaxes(images, -1, -2)


def past_window(diagrams: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Pairs whose persistence lies past the image's window: int32, over the last two axes of the fields."""
    past = diagrams.mask & (diagrams.deaths - diagrams.births > config.window)
    return past.sum(axis=(-2, -1), dtype=jnp.int32)
