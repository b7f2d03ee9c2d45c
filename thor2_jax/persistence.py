"""Sublevel-set persistence (H0) of functions on lines, and persistence images, for batches in JAX.

A function on a line is a row of heights, with or without heights of the edges between neighbours: a signal, a profile,
or any filtration on a path. All arrays have fixed shapes, so that diagrams and images can be computed under `jax.jit`
and `jax.vmap` on any device, and have gradients.

>>> heights = jax.numpy.array([0.0, 2.0, 1.0, 3.0])  # the minimum at 1 merges with the one at 0 over 2
>>> diagrams = sublevel_diagrams(heights)
>>> diagrams.births[diagrams.mask], diagrams.deaths[diagrams.mask]
(Array([1.], dtype=float32), Array([2.], dtype=float32))
>>> images(diagrams, birth_range=(0, 3), persistence_range=(0, 3), pixels=(8, 8), variance=0.1).shape
(8, 8)

This module does not handle simplicial complexes: it has no triangles, no cycles (H1 and above), no Rips or alpha
complexes, and no distances between diagrams. Use GUDHI for these.
"""

import math
import reprlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from numpy.typing import NDArray

from thor2_jax.descriptor.persistence import cumulative_at_edges, persistence_power
from thor2_jax.errors import InputError
from thor2_jax.types import Diagrams, check_types, is_positive_integer, matmul

__all__ = ["Diagrams", "images", "sublevel_diagrams"]

_Tables = tuple[jax.Array, jax.Array]
"""Lowest vertex, and index of the highest edge, in the range that follows each vertex, each [N]."""


def sublevel_diagrams(heights: ArrayLike, edges: ArrayLike | None = None) -> Diagrams:
    """Return the finite H0 pairs of functions on lines: births and merges of the components of sublevel sets.

    A component is born at its lowest vertex and dies at the edge that joins it to a component with a lower vertex (the
    elder rule; of equal heights, the first is older). The component of the lowest vertex of a line never dies; it has
    no pair, and its birth is the minimum of the heights. For superlevel sets, negate the heights and the result.

    Pairs are found by binary search in tables of ranges, in O(N log N) operations and memory and log2(N) steps for each
    line. Gradients flow to the height of the vertex and of the edge of each pair; without `edges`, to the higher vertex
    of the edge. They exist where no two heights are equal.

    Args:
        heights: [..., N] floating, one height for each vertex. A vertex of height NaN, infinity or -infinity is absent
            and its neighbours are not connected, so that lines of different lengths are padded with any of these.
        edges: [..., N - 1] floating, height of the edge between vertices i and i + 1; by default that of the higher
            vertex. A lower edge is raised to that height, since an edge cannot appear before its vertices; NaN or
            infinity cuts the line.

    Returns:
        Diagrams with fields [..., N] of the type of `heights`. Pair i is born at vertex i. The mask is True for pairs
        of positive persistence, at most (N + 1) // 2; elsewhere births and deaths are 0.

    Raises:
        InputError: `heights` or `edges` is not floating, or has another shape.
    """
    heights = _as_jax("heights", heights, "floating [..., N]")
    if heights.ndim == 0 or not jnp.issubdtype(heights.dtype, jnp.floating):
        raise InputError(f"heights is {heights.dtype} {list(heights.shape)}; expected floating [..., N]")
    if edges is not None:
        edges = _as_jax("edges", edges, "floating [..., N - 1]")
        shape = (*heights.shape[:-1], max(heights.shape[-1] - 1, 0))
        if edges.shape != shape or not jnp.issubdtype(edges.dtype, jnp.floating):
            raise InputError(
                f"edges is {edges.dtype} {list(edges.shape)}; expected floating {list(shape)}, one for each pair of "
                f"neighbours in heights {list(heights.shape)}"
            )
    return _sublevel_diagrams(heights, edges)


def _as_jax(name: str, values: ArrayLike, expected: str) -> jax.Array:
    """Return the values as an array of JAX, which takes no NumPy arrays of the other byte order."""
    if isinstance(values, np.ndarray):
        values = values.astype(values.dtype.newbyteorder("="), copy=False)
    try:
        return jnp.asarray(values)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {reprlib.repr(values)}; expected {expected}, rows of equal length") from None


@jax.jit
def _sublevel_diagrams(heights: jax.Array, edges: jax.Array | None) -> Diagrams:
    heights = jnp.where(jnp.isfinite(heights), heights, jnp.inf)
    left, right = heights[..., :-1], heights[..., 1:]
    lowest = jnp.where(left >= right, left, right)
    edges = lowest if edges is None else edges
    edges = jnp.where(edges > lowest, edges.astype(heights.dtype), jnp.where(jnp.isnan(edges), jnp.inf, lowest))
    if edges.size == 0:
        return Diagrams(jnp.zeros_like(heights), jnp.zeros_like(heights), jnp.zeros(heights.shape, bool))
    index = jnp.vectorize(_death_edges, signature="(n),(m)->(n)")(*jax.lax.stop_gradient((heights, edges)))
    deaths = jnp.take_along_axis(edges, jnp.maximum(index, 0), axis=-1)
    mask = (index >= 0) & jnp.isfinite(heights) & (deaths > heights)
    return Diagrams(births=jnp.where(mask, heights, 0), deaths=jnp.where(mask, deaths, 0), mask=mask)


def _death_edges(heights: jax.Array, edges: jax.Array) -> jax.Array:
    """Return the edge at which the component born at each vertex dies, [N] int32; -1 if it never does.

    There may be a lower vertex on either side; the component merges on the side whose highest edge is lower.
    """
    right, right_index = _edges_to_lower(heights, edges, or_equal=False)
    left, left_index = _edges_to_lower(heights[::-1], edges[::-1], or_equal=True)
    left, left_index = left[::-1], len(edges) - 1 - left_index[::-1]
    never = jnp.isinf(jnp.minimum(left, right))
    return jnp.where(never, -1, jnp.where(right < left, right_index, left_index))


def _edges_to_lower(heights: jax.Array, edges: jax.Array, or_equal: bool) -> tuple[jax.Array, jax.Array]:
    """Return the highest edge between each vertex and the next lower one to its right: its height and index, [N].

    The height is infinite if no vertex there is lower (or equal, with `or_equal`).
    """
    n, vertices = len(heights), jnp.arange(len(heights), dtype=jnp.int32)
    # A sentinel after the last vertex is lower than all others; edge n - 1, to it, is infinitely high. Edge n is none.
    edge_heights = jnp.append(edges, jnp.array([jnp.inf, -jnp.inf], edges.dtype))
    low = jnp.append(heights[1:], -jnp.inf)  # lowest of the vertices i + 1 .. i + 2^k, for k = 0

    def higher(first: jax.Array, second: jax.Array) -> jax.Array:
        return jnp.where(edge_heights[second] > edge_heights[first], second, first)

    def double(tables: _Tables, width: jax.Array) -> tuple[_Tables, _Tables]:
        low, highest = tables  # highest of the edges i .. i + 2^k - 1
        inside, second = vertices + width < n, jnp.minimum(vertices + width, n - 1)
        lowest = jnp.minimum(low, jnp.where(inside, low[second], -jnp.inf))
        return (lowest, higher(highest, jnp.where(inside, highest[second], n - 1))), tables

    def walk(reached: _Tables, tables: tuple[_Tables, jax.Array]) -> tuple[_Tables, None]:
        """Step over a range of each vertex that has no lower vertex; note the highest edge on the way."""
        (low, highest), width = tables
        position, index = reached
        passed = (low[position] > heights) if or_equal else (low[position] >= heights)
        index = jnp.where(passed, higher(index, highest[position]), index)
        return (jnp.where(passed, position + width, position), index), None

    widths = jnp.array([2**k for k in range((n - 1).bit_length())], jnp.int32)
    _, tables = jax.lax.scan(double, (low, vertices), widths)
    (position, index), _ = jax.lax.scan(walk, (vertices, jnp.full_like(vertices, n)), (tables, widths), reverse=True)
    index = higher(index, position)  # the edge from the last vertex that is not lower
    return edge_heights[index], index


def images(
    diagrams: Diagrams,
    *,
    birth_range: tuple[float, float],
    persistence_range: tuple[float, float],
    pixels: tuple[int, int],
    variance: ArrayLike,
    exponent: ArrayLike = 1.0,
) -> jax.Array:
    """Return persistence images: the sum over pairs of persistence**n times a Gaussian, integrated over each pixel.

    These are the images of Adams et al. (2017). Gaussians are clipped to the ranges, also those of pairs outside them.
    Gradients flow to the diagrams, `variance` and `exponent`.

    Args:
        diagrams: births, deaths and mask [..., N], from `sublevel_diagrams` or any other source, without pairs that are
            not finite, such as that of the component that never dies.
        birth_range: smallest and largest birth of the image. Static, as are the next two.
        persistence_range: smallest and largest persistence of the image.
        pixels: number of pixels P along births, and Q along persistence.
        variance: [], variance of the Gaussian, positive (persim calls it `sigma`).
        exponent: [], exponent n of the weight, positive.

    Returns:
        [..., P, Q] of the type of the births, axes birth and persistence. The image of an empty diagram is zero.

    Raises:
        InputError: `diagrams` is of another type, not floating or not of one shape, a range is not two increasing
            numbers that are finite and differ in the type of the births, `pixels` is not two positive integers, or
            `variance` or `exponent` is not a positive number.
    """
    check_types(diagrams=diagrams)
    diagrams = jax.tree.map(lambda values: _as_jax("diagrams", values, "arrays"), diagrams)
    dtype = getattr(diagrams.births, "dtype", None)
    shapes = {getattr(a, "shape", None) for a in vars(diagrams).values()}
    if dtype is None or not jnp.issubdtype(dtype, jnp.floating) or len(shapes) > 1:
        births = reprlib.repr(diagrams.births)
        raise InputError(f"diagrams has births {births} and shapes {shapes}; expected floating arrays of one shape")
    for name, bounds in (("birth_range", birth_range), ("persistence_range", persistence_range)):
        numbers = _real_numbers(bounds, (2,), dtype)
        if numbers is None or not -math.inf < numbers[0] < numbers[1] < math.inf:
            raise InputError(f"{name} is {bounds!r}; expected two finite {dtype} numbers, the smaller one first")
    if _real_numbers(pixels, (2,), dtype) is None or not all(map(is_positive_integer, pixels)):
        raise InputError(f"pixels is {pixels!r}; expected two positive integers")
    for name, value in (("variance", variance), ("exponent", exponent)):
        if isinstance(value, jax.core.Tracer):
            continue
        number = _real_numbers(value, (), dtype)
        if number is None or not 0 < number < math.inf:
            raise InputError(f"{name} is {value!r}; expected a positive number")
    ends = (birth_range, pixels[0]), (persistence_range, pixels[1])
    edges = (jnp.linspace(*bounds, n + 1, dtype=dtype) for bounds, n in ends)
    return _images(diagrams, *edges, jnp.asarray(variance, dtype), exponent)


def _real_numbers(values: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any] | None:
    """Return the values in a floating type; None if they are no real numbers or have another shape."""
    try:
        numbers = np.asarray(values)
    except ValueError:
        return None
    if numbers.shape != shape or not jnp.issubdtype(numbers.dtype, jnp.number) or np.iscomplexobj(numbers):
        return None
    with np.errstate(over="ignore"):  # infinite numbers are refused
        return numbers.astype(dtype)


@jax.jit
def _images(
    diagrams: Diagrams, birth_edges: jax.Array, persistence_edges: jax.Array, variance: ArrayLike, exponent: ArrayLike
) -> jax.Array:
    births = jnp.where(diagrams.mask, diagrams.births, 0)
    persistence = jnp.where(diagrams.mask, diagrams.deaths - diagrams.births, 0)
    by_birth = jnp.diff(cumulative_at_edges(births, variance, birth_edges), axis=-2)
    by_persistence = jnp.diff(cumulative_at_edges(persistence, variance, persistence_edges), axis=-2)
    weighted = by_persistence * persistence_power(persistence, exponent)[..., None, :]
    return matmul(by_birth, jnp.swapaxes(weighted, -1, -2)) / 4
