"""Diagrams of functions on lines against gudhi, images against persim, gradients against differences of both."""

import math
from typing import Any

import gudhi
import jax
import numpy as np
import persim
import pytest
from refusals import assert_refused
from slow_tier import slow

import thor2_jax as thor2
from thor2_jax import persistence


def gudhi_pairs(heights: np.ndarray, edges: np.ndarray | None = None) -> np.ndarray:
    """Return the finite pairs of positive persistence of one line, [k, 2] sorted."""
    tree = gudhi.SimplexTree()
    for i, height in enumerate(heights):
        if np.isfinite(height):
            tree.insert([i], float(height))
    for i in range(len(heights) - 1):
        height = max(heights[i], heights[i + 1], -np.inf if edges is None else edges[i])
        if np.isfinite([heights[i], heights[i + 1], height]).all():
            tree.insert([i, i + 1], float(height))
    pairs = [p for dimension, p in tree.persistence() if dimension == 0 and math.isfinite(p[1])]
    return np.array(sorted(pairs)).reshape(-1, 2)


def assert_as_gudhi(heights: np.ndarray, edges: np.ndarray | None = None) -> None:
    """Compare a batch [B, N] line by line."""
    diagrams = persistence.sublevel_diagrams(heights, edges)
    assert diagrams.births.shape == diagrams.deaths.shape == diagrams.mask.shape == heights.shape
    assert diagrams.births.dtype == diagrams.deaths.dtype == heights.dtype
    for b in range(len(heights)):
        one = jax.tree.map(lambda a: np.asarray(a[b]), diagrams)  # noqa: B023  used at once
        pairs = sorted(zip(one.births[one.mask], one.deaths[one.mask], strict=True))
        expected = gudhi_pairs(heights[b], None if edges is None else edges[b])
        np.testing.assert_array_equal(np.reshape(pairs, (-1, 2)), expected)
        assert not one.births[~one.mask].any() and not one.deaths[~one.mask].any()
        np.testing.assert_array_equal(one.births[one.mask], heights[b][one.mask])


@pytest.mark.parametrize("n", [1, *slow(2), 9, 100])
def test_heights_of_vertices_and_edges(n: int) -> None:
    rng = np.random.default_rng(n)
    heights = rng.normal(size=(40, n)).astype(np.float32)
    equal = rng.integers(0, 3, (40, n)).astype(np.float32)
    for each in (heights, equal):
        assert_as_gudhi(each)
    assert_as_gudhi(heights, (rng.normal(size=(40, n - 1)) + 1).astype(np.float32))
    assert_as_gudhi(equal, rng.integers(0, 5, (40, n - 1)).astype(np.float32))


def test_absent_vertices_and_edges() -> None:
    rng = np.random.default_rng(0)
    heights = rng.normal(size=(30, 17)).astype(np.float32)
    edges = (rng.normal(size=(30, 16)) + 1).astype(np.float32)
    heights[rng.random(heights.shape) < 0.2] = np.nan
    edges[rng.random(edges.shape) < 0.2] = np.nan
    expected = np.where(np.isnan(heights), np.inf, heights), np.where(np.isnan(edges), np.inf, edges)
    for values, gaps in ((expected[0], None), expected):
        first = persistence.sublevel_diagrams(heights, None if gaps is None else edges)
        assert_as_gudhi(values, gaps)
        jax.tree.map(np.testing.assert_array_equal, first, persistence.sublevel_diagrams(values, gaps))
    assert_as_gudhi(np.where(np.isinf(expected[0]), -np.inf, heights))  # for superlevel sets
    short = np.where(np.arange(17) < 9, expected[0], np.inf)
    assert_as_gudhi(short)
    assert len(gudhi_pairs(short[0])) == len(gudhi_pairs(expected[0][0, :9]))


def test_leading_axes_vmap_and_the_other_byte_order() -> None:
    for shape in ((0,), (1,), (0, 5), (4, 5, 9)):
        heights = np.random.default_rng(0).normal(size=shape).astype(np.float32)
        edges = heights[..., 1:] + np.float32(1)
        diagrams = persistence.sublevel_diagrams(heights, edges)
        assert diagrams.mask.shape == diagrams.births.shape == shape and diagrams.mask.any() == (len(shape) == 3)
        swapped = persistence.sublevel_diagrams(heights.astype(">f4"), edges.astype(">f4"))
        jax.tree.map(np.testing.assert_array_equal, swapped, diagrams)
    nested = jax.vmap(jax.vmap(persistence.sublevel_diagrams))(heights, edges)
    jax.tree.map(np.testing.assert_array_equal, diagrams, nested)


IMAGE: dict[str, Any] = {"birth_range": (-2.0, 2.0), "persistence_range": (0.0, 3.0), "pixels": (8, 6)}


def persim_image(pairs: np.ndarray, variance: float, exponent: float) -> np.ndarray:
    """Return the image of `IMAGE`; `sigma` of persim is a variance."""
    imager = persim.PersistenceImager(
        birth_range=IMAGE["birth_range"],
        pers_range=IMAGE["persistence_range"],
        pixel_size=0.5,
        weight="persistence",
        weight_params={"n": exponent},
        kernel_params={"sigma": [[variance, 0.0], [0.0, variance]]},
    )
    return np.asarray(imager.transform(pairs, skew=True))


@pytest.mark.parametrize(("variance", "exponent"), [(0.05, 1.0), (0.3, 2.0), (0.01, 0.5)])
def test_images_against_persim(variance: float, exponent: float) -> None:
    heights = np.random.default_rng(1).normal(size=(3, 40)).astype(np.float32)
    images = persistence.images(persistence.sublevel_diagrams(heights), **IMAGE, variance=variance, exponent=exponent)
    assert images.shape == (3, 8, 6) and images.dtype == np.float32
    for image, line in zip(images, heights, strict=True):
        pairs = gudhi_pairs(line)
        np.testing.assert_allclose(image, persim_image(pairs, variance, exponent), atol=2e-6)
        for dtype in (np.float32, np.float64, ">f4"):  # diagrams of another source
            other = persistence.Diagrams(*pairs.T.astype(dtype), np.ones(len(pairs), bool))
            same = persistence.images(other, **IMAGE, variance=variance, exponent=exponent)
            np.testing.assert_allclose(same, image, atol=2e-6)


def test_the_image_of_no_pairs_is_zero_with_zero_gradients() -> None:
    @jax.jit
    @jax.value_and_grad
    def total(heights: jax.Array) -> jax.Array:
        return persistence.images(persistence.sublevel_diagrams(heights), **IMAGE, variance=0.1).sum()

    for heights in (np.arange(5), np.full(5, np.nan), np.zeros(5)):
        value, gradient = total(heights.astype(np.float32))
        assert value == 0 and not gradient.any()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("with_edges", [False, True])
def test_gradients_against_differences_of_gudhi_and_persim(with_edges: bool) -> None:
    """Gradients of heights, edges, variance and exponent, which one array holds in this order."""
    rng = np.random.default_rng(2)
    arguments = np.concatenate([rng.normal(size=12), rng.normal(size=11) + 1.5, [0.1, 1.5]])
    probe = rng.random(IMAGE["pixels"])

    def expected(values: np.ndarray) -> float:
        pairs = gudhi_pairs(values[:12], values[12:23] if with_edges else None)
        return float((persim_image(pairs, *values[23:]) * probe).sum())

    @jax.value_and_grad
    def actual(values: jax.Array) -> jax.Array:
        diagrams = persistence.sublevel_diagrams(values[:12], values[12:23] if with_edges else None)
        return (persistence.images(diagrams, **IMAGE, variance=values[23], exponent=values[24]) * probe).sum()

    assert len(gudhi_pairs(arguments[:12], arguments[12:23] if with_edges else None)) >= 3
    value, gradient = jax.jit(actual)(arguments)
    np.testing.assert_allclose(value, expected(arguments), rtol=1e-9)
    steps = np.eye(len(arguments)) * 1e-5
    differences = [(expected(arguments + step) - expected(arguments - step)) / 2e-5 for step in steps]
    assert gradient.dtype == np.float64
    np.testing.assert_allclose(gradient, differences, rtol=1e-5, atol=1e-7)


SOME, RAGGED = np.zeros(3, np.float32), [[1.0, 2.0], [1.0]]
BAD_EDGES = ((SOME, SOME), (np.zeros((2, 3), np.float32), SOME[:2]), (SOME, np.zeros(2, np.int32)), (SOME, RAGGED))


def test_bad_heights_and_edges() -> None:
    for heights in (np.zeros(3, np.int32), np.float32(1), None, "high", RAGGED):
        assert_refused("^heights is [^\n]*$", persistence.sublevel_diagrams, heights)
    for heights, edges in BAD_EDGES:
        assert_refused("^edges is [^\n]*$", persistence.sublevel_diagrams, heights, edges)


BAD_OPTIONS: dict[str, list[Any]] = {
    "birth_range": [(1.0, 1.0), 3.0, ("0", "1")],
    "persistence_range": [(0.0, math.inf), (0.0, 1e39), (1.0, 1.0 + 1e-12)],
    "pixels": [(8, 0), (8,), 8, (8, [6])],
    "variance": ["0.1", RAGGED, None, True, 0, np.float32(0), np.full(2, -1.0)],
    "exponent": [1j, -1.0],
    "diagrams": [
        np.zeros((3, 2)),
        *(thor2.Diagrams(*[births] * 3) for births in (np.zeros(3, int), [0.0, 1.0])),
        *(thor2.Diagrams(SOME, np.ones(size, np.float32), SOME > 0) for size in (1, 4)),
    ],
}


def test_options_of_images_are_numbers_of_any_kind() -> None:
    diagrams = persistence.sublevel_diagrams(np.array([0, 2, 1, 3], np.float32))
    options: dict[str, Any] = {"diagrams": diagrams, **IMAGE, "pixels": (np.int64(4), 4)}
    images = [persistence.images(**options, variance=kind(1), exponent=kind(2)) for kind in (int, float)]
    assert images[0].shape == (4, 4)
    np.testing.assert_array_equal(*images)
    for name, values in BAD_OPTIONS.items():
        for value in values:
            bad = {**options, "variance": 0.1} | {name: value}
            assert_refused(f"^{name} (is|has births) [^\n]*$", persistence.images, **bad)
