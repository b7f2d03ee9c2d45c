"""Persistence images (Adams et al. 2017; paper, section "TOPS"): a slice's diagram becomes a small picture."""

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr

from thor2_jax.config import DescriptorConfig
from thor2_jax.slicing import strip_births
from thor2_jax.types import Diagrams

__all__ = ["past_window", "persistence_images"]


def _pixel_mass(centres: jax.Array, config: DescriptorConfig) -> jax.Array:
    """Integral of the Gaussian at each of `centres` [..., J] over each pixel of an axis: [..., P, J]."""
    edges = (jnp.arange(config.image_size + 1) - 1) * config.sigma_2
    z = (edges.astype(centres.dtype)[:, None] - centres[..., None, :]) / jnp.sqrt(config.image_variance)
    return jnp.diff(ndtr(z), axis=-2)


def persistence_images(diagrams: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Sum over the pairs of persistence x Gaussian, integrated over each pixel.

    The Gaussian is separable, so an image is one product of two tables. The one for births is the same for all slices:
    pair j is born with strip j.

    Args:
        diagrams: of any number of slices, fields [..., J].
        config: static.

    Returns:
        [..., P, P] float32, axes birth and persistence, both over [-sigma_2, (P - 1) sigma_2]; zeros for an empty
        diagram.
    """
    persistence = jnp.where(diagrams.mask, diagrams.deaths - diagrams.births, 0)
    # The weight is the persistence: padding adds nothing.
    by_persistence = _pixel_mass(persistence, config) * persistence[..., None, :]
    by_birth = _pixel_mass(strip_births(config), config)
    images = jnp.matmul(by_persistence, by_birth.T, precision=jax.lax.Precision.HIGHEST)
    return jnp.swapaxes(images, -1, -2)


def past_window(diagrams: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Pairs whose persistence lies past the image's window: int32, over the last two axes of the fields."""
    past = diagrams.mask & (diagrams.deaths - diagrams.births > config.window)
    return past.sum(axis=(-2, -1), dtype=jnp.int32)
