"""Sums and extremes over the points of a cloud, vectorized for CPUs.

XLA keeps the order of a reduction of floats along the last axis and so computes it one number at a time. Folding the
axis into rows that are combined elementwise uses vector registers and is several times as fast. Each docstring names
the plain expression that gives the same result, up to rounding of sums.

The loops use functions of `jax.lax`. Indexing and `jnp.where` compute the same and take longer to trace: with them,
`align` and `describe` take a fifth longer to compile.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

__all__ = ["ROWS", "argmax", "fold", "larger", "largest", "rows_of", "smaller", "smallest", "total"]

ROWS = 16
"""Number of rows that the last axis is folded into; its length must be a multiple."""

_PLAIN_LENGTH = 8
"""Largest length at which a plain argmax is as fast as halving."""


def larger(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return `jnp.maximum(a, b)` of numbers other than NaN, in one instruction; passing on NaN takes more."""
    return jax.lax.select(jax.lax.gt(a, b), a, b)


def smaller(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return `jnp.minimum(a, b)` of numbers other than NaN, in one instruction."""
    return jax.lax.select(jax.lax.lt(a, b), a, b)


def rows_of(folded: jax.Array) -> list[jax.Array]:
    """Return `[folded[..., k, :] for k in range(K)]`, [..., K, N]."""
    return [jax.lax.index_in_dim(folded, k, axis=-2, keepdims=False) for k in range(folded.shape[-2])]


def fold(values: jax.Array, op: Callable[[jax.Array, jax.Array], jax.Array], rows: int = ROWS) -> jax.Array:
    """Combine the entries k, k + N / rows, k + 2 N / rows, ... by `op` into entry k: [..., N] to [..., N / rows]."""
    folded = values.reshape(*values.shape[:-1], rows, values.shape[-1] // rows)
    return functools.reduce(op, rows_of(folded))


def total(values: jax.Array) -> jax.Array:
    """Return `values.sum(axis=-1)`, [..., N] to [...]."""
    return fold(values, jnp.add).sum(axis=-1)


def largest(values: jax.Array) -> jax.Array:
    """Return `values.max(axis=-1)`, [..., N] to [...]."""
    return fold(values, larger).max(axis=-1)


def smallest(values: jax.Array) -> jax.Array:
    """Return `values.min(axis=-1)`, [..., N] to [...]."""
    return fold(values, smaller).min(axis=-1)


def _halves(values: jax.Array, half: int) -> list[jax.Array]:
    return [jax.lax.slice_in_dim(values, start, start + half, axis=-1) for start in (0, half)]


def argmax(values: jax.Array) -> jax.Array:
    """Return `values.argmax(axis=-1)` as int32, for any length > 0; any of several equal entries may be returned."""
    index = jnp.broadcast_to(jnp.arange(values.shape[-1], dtype=jnp.int32), values.shape)
    while values.shape[-1] > _PLAIN_LENGTH and values.shape[-1] % 2 == 0:
        half = values.shape[-1] // 2
        (first, second), indices = _halves(values, half), _halves(index, half)
        index = jax.lax.select(jax.lax.ge(first, second), *indices)
        values = larger(first, second)
    best = jnp.argmax(values, axis=-1)[..., None]
    return jnp.take_along_axis(index, best, axis=-1)[..., 0]
