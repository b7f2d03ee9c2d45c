"""Persistence diagrams of slices and their images (paper, sections "Filtration" and "TOPS"; Adams et al. 2017).

The diagrams are computed by gudhi, in one host callback for a batch, or by a closed form.

In the filtration of a slice, strip j adds two vertices, its points of smallest and largest y, at j s2, and the edge
between them at j s2 + (y_max - y_min). Each strip is a separate connected component: one vertex dies when the edge is
added, the other one never dies. The finite H0 pairs are therefore (j s2, j s2 + y_max - y_min), one for each strip;
this is the closed form.
"""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf
from jax.typing import ArrayLike

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.slicing import strip_births
from thor2_jax.errors import InputError
from thor2_jax.types import Diagrams, Strips, matmul

__all__ = ["count_past_window", "cumulative_at_edges", "diagrams_of_strips", "persistence_images", "persistence_power"]


def diagrams_of_strips(strips: Strips, config: DescriptorConfig) -> Diagrams:
    """Return the finite H0 pairs of every slice, including those of zero persistence.

    Args:
        strips: fields [..., S, J]; one callback handles all leading axes together.
        config: its `homology` selects the backend. Static.

    Returns:
        Diagrams with fields [..., S, J]; pair j of a slice is that of strip j.

    Raises:
        InputError: `homology` is "gudhi", which is not installed.
    """
    births = jnp.broadcast_to(strip_births(config), strips.low.shape)
    edges = births + (strips.high - strips.low)
    if config.homology == "closed_form":
        birth, death, mask = births, edges, strips.occupied
    else:
        _load_gudhi()
        out = jax.ShapeDtypeStruct(strips.low.shape, jnp.int32)
        values = jax.lax.stop_gradient((births, edges))
        birth_index, death_index = jax.pure_callback(
            _gudhi_pairs, (out, out), *values, strips.occupied, vmap_method="expand_dims"
        )
        # gudhi returns which vertex and edge form a pair. JAX gathers their values, so that gradients flow to them.
        mask = death_index >= 0
        birth = jnp.take_along_axis(births, jnp.maximum(birth_index, 0), axis=-1)
        death = jnp.take_along_axis(edges, jnp.maximum(death_index, 0), axis=-1)
    return Diagrams(births=jnp.where(mask, birth, 0), deaths=jnp.where(mask, death, 0), mask=mask)


def _load_gudhi() -> Any:
    # It is neither on ARM nor in the small installation.
    try:
        return importlib.import_module("gudhi")
    except ModuleNotFoundError:
        raise InputError(
            'homology is "gudhi", which is not installed; expected DescriptorConfig(homology="closed_form"), which has '
            "the same pairs, or install gudhi"
        ) from None


def _gudhi_pairs(births: Any, edges: Any, occupied: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the strip of each pair's birth vertex and of its death edge, int32 [..., S, J]; -1 where there is no pair.

    Strips are numbered within their slice, so that the numbers hold for any leading axes that `vmap` adds.
    """
    births, edges, occupied = np.broadcast_arrays(births, edges, occupied)
    strip = np.flatnonzero(occupied).astype(np.int32)
    birth_index, death_index = np.full((2, occupied.size), -1, np.int32)
    if len(strip):
        vertex_at, edge_at = (a.reshape(-1)[strip].astype(np.float64) for a in (births, edges))
        first = np.arange(len(strip), dtype=np.int32) * 2
        tree = _load_gudhi().SimplexTree()
        tree.insert_batch(np.concatenate([first, first + 1])[None], np.concatenate([vertex_at, vertex_at]))
        tree.insert_batch(np.stack([first, first + 1]), edge_at)
        tree.compute_persistence(min_persistence=-1)
        pairs = tree.flag_persistence_generators()[0]  # rows: birth vertex, the death edge's two vertices
        death = strip[pairs[:, 1] // 2]
        n_strips = occupied.shape[-1]
        birth_index[death], death_index[death] = strip[pairs[:, 0] // 2] % n_strips, death % n_strips
    return birth_index.reshape(occupied.shape), death_index.reshape(occupied.shape)


def cumulative_at_edges(centres: jax.Array, variance: ArrayLike, edges: jax.Array) -> jax.Array:
    """Return 2 CDF - 1 of the normal distributions at `centres` [..., J] at `edges` [P + 1], [..., P + 1, J]."""
    # `ndtr` takes four times as long, for a precision in the far tails that an image does not need.
    return erf((edges[:, None] - centres[..., None, :]) * jax.lax.rsqrt(2 * variance))


def persistence_power(persistence: jax.Array, exponent: ArrayLike) -> jax.Array:
    """Return persistence**exponent: 0 at 0, with a finite gradient for any exponent; exactly `persistence` for 1."""
    return persistence * jnp.exp((exponent - 1) * jnp.log(jnp.where(persistence > 0, persistence, 1)))


def persistence_images(
    diagrams: Diagrams, config: DescriptorConfig, variance: ArrayLike, exponent: ArrayLike
) -> jax.Array:
    """Return the sum over pairs of persistence**n times a Gaussian, integrated over each pixel; the paper's n is 1.

    The Gaussian is separable, so that an image is the product of two tables. The table of births is the same for all
    slices because pair j is born with strip j.

    Args:
        diagrams: fields [..., J].
        config: settings of the descriptor; its variance and exponent are not read. Static.
        variance: [], variance of the Gaussian.
        exponent: [], exponent n.

    Returns:
        [..., P, P] float32, axes birth and persistence, both over [-sigma_2, (P - 1) sigma_2]. The image of an empty
        diagram is zero.
    """
    persistence = jnp.where(diagrams.mask, diagrams.deaths - diagrams.births, 0)
    births = strip_births(config)
    # Pad to whole vector registers; the padding adds nothing, since a pair without persistence has no weight.
    padding = -len(births) % 8
    persistence = jnp.pad(persistence, [(0, 0)] * (persistence.ndim - 1) + [(0, padding)])
    births = jnp.pad(births, (0, padding))
    weight = persistence_power(persistence, exponent)
    edges = (jnp.arange(config.image_size + 1, dtype=births.dtype) - 1) * config.sigma_2
    by_persistence = cumulative_at_edges(persistence, variance, edges) * weight[..., None, :]
    by_birth = jnp.diff(cumulative_at_edges(births, variance, edges), axis=-2)
    # Take differences along persistence after the product; before it, XLA would evaluate each edge's `erf` twice.
    images = jnp.diff(matmul(by_persistence, by_birth.T), axis=-2) / 4
    return jnp.swapaxes(images, -1, -2)


def count_past_window(diagrams: Diagrams, config: DescriptorConfig) -> jax.Array:
    """Count the pairs of each cloud whose persistence exceeds the image window: fields [..., S, J] to [...] int32."""
    exceeds = diagrams.mask & (diagrams.deaths - diagrams.births > config.window)
    return exceeds.sum(axis=(-2, -1), dtype=jnp.int32)
