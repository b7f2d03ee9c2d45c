"""Persistence images of slices (Adams et al. 2017; paper, section "TOPS")."""

import jax
import jax.numpy as jnp
from jax.scipy.special import erf
from jax.typing import ArrayLike

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.slicing import strip_births
from thor2_jax.types import Diagrams

__all__ = ["count_past_window", "cumulative_at_edges", "persistence_images", "persistence_power"]


def cumulative_at_edges(centres: jax.Array, variance: ArrayLike, edges: jax.Array) -> jax.Array:
    """Return 2 CDF - 1 of the normal distributions at `centres` [..., J] at `edges` [P + 1], [..., P + 1, J]."""
    # `ndtr` costs four times as much, for digits of far tails that an image does not need.
    return erf((edges[:, None] - centres[..., None, :]) * jax.lax.rsqrt(2 * variance))


def persistence_power(persistence: jax.Array, exponent: ArrayLike) -> jax.Array:
    """Return persistence**exponent: 0 at 0, with a finite gradient for any exponent; exactly `persistence` for 1."""
    return persistence * jnp.exp((exponent - 1) * jnp.log(jnp.where(persistence > 0, persistence, 1)))


def persistence_images(
    diagrams: Diagrams,
    config: DescriptorConfig,
    variance: ArrayLike | None = None,
    persistence_weight: ArrayLike | None = None,
) -> jax.Array:
    """Return the sum over pairs of persistence**n times a Gaussian, integrated over each pixel; the paper's n is 1.

    The Gaussian is separable, so that an image is the product of two tables. The table of births is the same for all
    slices because pair j is born with strip j.

    Args:
        diagrams: fields [..., J].
        config: static.
        variance: [], variance of the Gaussian; by default `config.image_variance`.
        persistence_weight: [], exponent n; by default `config.persistence_weight`.

    Returns:
        [..., P, P] float32, axes birth and persistence, both over [-sigma_2, (P - 1) sigma_2]. The image of an empty
        diagram is zero.
    """
    persistence = jnp.where(diagrams.mask, diagrams.deaths - diagrams.births, 0)
    births = strip_births(config)
    # Fill whole vector registers; a pair without persistence has no weight, so the padding adds nothing.
    padding = -len(births) % 8
    persistence = jnp.pad(persistence, [(0, 0)] * (persistence.ndim - 1) + [(0, padding)])
    births = jnp.pad(births, (0, padding))
    variance = config.image_variance if variance is None else variance
    weight = persistence_power(
        persistence, config.persistence_weight if persistence_weight is None else persistence_weight
    )
    edges = (jnp.arange(config.image_size + 1, dtype=births.dtype) - 1) * config.sigma_2
    by_persistence = cumulative_at_edges(persistence, variance, edges) * weight[..., None, :]
    by_birth = jnp.diff(cumulative_at_edges(births, variance, edges), axis=-2)
    # Differences along persistence come after the product: before it, XLA evaluates each edge's `erf` twice.
    images = jnp.diff(jnp.matmul(by_persistence, by_birth.T, precision=jax.lax.Precision.HIGHEST), axis=-2) / 4
    return jnp.swapaxes(images, -1, -2)


def count_past_window(diagrams: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Count the pairs of each cloud whose persistence exceeds the image window: fields [..., S, J] to [...] int32."""
    exceeds = diagrams.mask & (diagrams.deaths - diagrams.births > config.window)
    return exceeds.sum(axis=(-2, -1), dtype=jnp.int32)
