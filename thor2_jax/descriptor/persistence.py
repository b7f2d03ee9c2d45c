"""Persistence diagrams of slices (paper, section "Filtration").

They come from gudhi, through one host callback for a batch, or from a closed form.

In the filtration of a slice, strip j adds two vertices, its points of least and greatest y, at j s2, and the edge
between them at j s2 + (y_max - y_min). Each strip is a connected component of its own: one vertex dies when the edge
is added, the other one never dies. The finite H0 pairs are therefore (j s2, j s2 + y_max - y_min), one for each strip;
this is the closed form.
"""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.slicing import strip_births
from thor2_jax.errors import InputError
from thor2_jax.types import Diagrams, Strips

__all__ = ["diagrams_of_strips"]


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
        # gudhi returns which vertex and edge form a pair. JAX gathers the values, so that gradients reach them.
        mask = death_index >= 0
        birth = jnp.take_along_axis(births, jnp.maximum(birth_index, 0), axis=-1)
        death = jnp.take_along_axis(edges, jnp.maximum(death_index, 0), axis=-1)
    return Diagrams(births=jnp.where(mask, birth, 0), deaths=jnp.where(mask, death, 0), mask=mask)


def _load_gudhi() -> Any:
    # It has no wheels for ARM, where the closed form is used.
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
    births, edges, occupied = (np.asarray(a) for a in (births, edges, occupied))
    shape = np.broadcast_shapes(births.shape, edges.shape, occupied.shape)
    strip = np.flatnonzero(np.broadcast_to(occupied, shape)).astype(np.int32)
    birth_index, death_index = np.full((2, int(np.prod(shape))), -1, np.int32)
    if len(strip):
        vertex_at = np.broadcast_to(births, shape).reshape(-1)[strip].astype(np.float64)
        edge_at = np.broadcast_to(edges, shape).reshape(-1)[strip].astype(np.float64)
        low = np.arange(len(strip), dtype=np.int32) * 2
        tree = _load_gudhi().SimplexTree()
        tree.insert_batch(np.concatenate([low, low + 1])[None], np.concatenate([vertex_at, vertex_at]))
        tree.insert_batch(np.stack([low, low + 1]), edge_at)
        tree.compute_persistence(min_persistence=-1)
        pairs = tree.flag_persistence_generators()[0]  # rows: birth vertex, the death edge's two vertices
        death = strip[pairs[:, 1] // 2]
        birth_index[death], death_index[death] = strip[pairs[:, 0] // 2] % shape[-1], death % shape[-1]
    return birth_index.reshape(shape), death_index.reshape(shape)
