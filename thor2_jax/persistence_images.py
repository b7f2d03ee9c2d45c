"""Persistence images (Adams et al. 2017; paper, section "TOPS"): one slice's diagram becomes a small picture."""

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr

from thor2_jax.config import DescriptorConfig
from thor2_jax.types import Diagrams

__all__ = ["persistence_image", "past_window"]


def _pixel_mass(centres: jax.Array, config: DescriptorConfig) -> jax.Array:
    """Integral of the Gaussian at each of `centres` [...] over each pixel of an axis: [..., P]."""
    edges = (jnp.arange(config.image_size + 1) - 1) * config.sigma_2
    z = (edges.astype(centres.dtype) - centres[..., None]) / jnp.sqrt(config.image_variance)
    return jnp.diff(ndtr(z), axis=-1)


def persistence_image(diagram: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Sum over the pairs of persistence x Gaussian, integrated over each pixel.

    The Gaussian is separable, so the image is one product of two tables.

    Args:
        diagram: one slice's, fields [J].
        config: static.

    Returns:
        [P, P] float32, axes birth and persistence, both over [-sigma_2, (P - 1) sigma_2]; zeros for an empty diagram.
    """
    persistence = jnp.where(diagram.mask, diagram.deaths - diagram.births, 0)
    by_birth = _pixel_mass(diagram.births, config)
    # The weight is the persistence: padding adds nothing.
    by_persistence = _pixel_mass(persistence, config) * persistence[:, None]
    return jnp.matmul(by_birth.T, by_persistence, precision=jax.lax.Precision.HIGHEST)


def past_window(diagrams: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Pairs whose persistence lies past the image's window: int32, over the last two axes of the fields."""
    past = diagrams.mask & (diagrams.deaths - diagrams.births > config.window)
    return past.sum(axis=(-2, -1), dtype=jnp.int32)
