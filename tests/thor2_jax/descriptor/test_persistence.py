"""Diagrams of both backends against one gudhi tree for each slice, built from the definition."""

from functools import partial
from typing import Any

import gudhi
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thor2_jax as thor2
from thor2_jax.descriptor.persistence import diagrams_of_strips

GUDHI, CLOSED = thor2.DescriptorConfig(), thor2.DescriptorConfig(homology="closed_form")


def plain_pairs(points: np.ndarray) -> list[np.ndarray]:
    """Return the finite H0 pairs of each slice, [k, 2] sorted: each strip is two vertices and an edge of a complex."""
    i, j = np.floor(points[:, 2] / 0.1).astype(int), np.floor(points[:, 0] / 0.025).astype(int)
    slices = []
    for a in range(7):
        tree = gudhi.SimplexTree()
        for b in np.unique(j[(i == a) & (j < 31)]):
            y = points[(i == a) & (j == b), 1]
            low, high, birth = 2 * int(b), 2 * int(b) + 1, b * 0.025
            tree.insert([low], birth)
            tree.insert([high], birth)
            tree.insert([low, high], birth + (y.max() - y.min()))
        pairs = np.array([p for dim, p in tree.persistence(min_persistence=-1) if dim == 0 and np.isfinite(p[1])])
        pairs = pairs.reshape(-1, 2)
        slices.append(pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))])
    return slices


def random_cloud(rng: np.random.Generator, n: int) -> np.ndarray:
    points = (rng.random((n, 3)) * rng.uniform(0.1, 1, 3) * [0.77, 0.7, 0.69]).astype(np.float32)
    for axis, width in ((0, 0.025), (2, 0.1)):
        border = np.round(points[:, axis] / width) * width
        points[np.abs(points[:, axis] - border) < 1e-5, axis] += np.float32(1e-3)
    return points


def pack(clouds: list[np.ndarray], capacity: int | None = None) -> thor2.PointClouds:
    return thor2.PointClouds.pack([(points, np.zeros(points.shape)) for points in clouds], capacity)


@pytest.mark.parametrize("config", [GUDHI, CLOSED], ids=["gudhi", "closed_form"])
def test_pairs_against_one_tree_per_slice(config: thor2.DescriptorConfig) -> None:
    rng = np.random.default_rng(0)
    clouds = [random_cloud(rng, n) for n in (0, 1, 2, 3, 50, 333, 512, 511)]
    diagrams = thor2.diagrams(pack(clouds), config)
    assert diagrams.births.shape == diagrams.deaths.shape == diagrams.mask.shape == (8, 7, 31)
    assert diagrams.births.dtype == diagrams.deaths.dtype == jnp.float32
    for b, points in enumerate(clouds):
        for s, expected in enumerate(plain_pairs(points.astype(np.float64))):
            mask = np.asarray(diagrams.mask[b, s])
            pairs = np.stack([diagrams.births[b, s], diagrams.deaths[b, s]], axis=1)[mask]
            np.testing.assert_allclose(pairs, expected, atol=2e-7)
            np.testing.assert_array_equal(np.asarray(diagrams.births[b, s])[~mask], 0)
            np.testing.assert_array_equal(np.asarray(diagrams.deaths[b, s])[~mask], 0)


def assert_same(first: Any, second: Any) -> None:
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("convention", ["paper", "released"])
def test_both_backends_give_equal_pairs(convention: str) -> None:
    rng = np.random.default_rng(1)
    clouds = [random_cloud(rng, int(n)) for n in rng.integers(0, 257, 1000)]
    for start in range(0, 1000, 250):
        packed = pack(clouds[start : start + 250], 256)
        first, second = (
            thor2.diagrams(packed, thor2.DescriptorConfig(homology=homology, convention=convention))
            for homology in ("gudhi", "closed_form")
        )
        assert_same(first, second)
        assert int(first.mask.sum()) > 1000


def strips_of(n_clouds: int) -> thor2.Strips:
    rng = np.random.default_rng(2)
    low = rng.random((n_clouds, 7, 31)).astype(np.float32)
    high = low + rng.random(low.shape).astype(np.float32) * rng.integers(0, 2, low.shape)  # some have length zero
    occupied = rng.random(low.shape) < 0.5
    return thor2.Strips(
        low=jnp.where(occupied, low, 0),
        high=jnp.where(occupied, high, 0),
        occupied=jnp.asarray(occupied),
        color=jnp.zeros((n_clouds, 7, 31, 22)),
        overflow=jnp.zeros((n_clouds, 7), jnp.int32),
    )


@pytest.mark.slow
@pytest.mark.parametrize("n_clouds", [0, 1, 5])
def test_with_and_without_jit_and_vmap(n_clouds: int) -> None:
    strips = strips_of(n_clouds)
    expected = jax.jit(diagrams_of_strips, static_argnums=1)(strips, CLOSED)
    for config in (GUDHI, CLOSED):
        plain = partial(diagrams_of_strips, config=config)
        functions = [plain, jax.jit(plain), jax.jit(jax.vmap(plain)), jax.jit(jax.vmap(jax.vmap(plain)))]
        for function in functions if n_clouds else functions[:2]:
            assert_same(function(strips), expected)


def test_one_callback_per_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    trees = []
    make = gudhi.SimplexTree
    monkeypatch.setattr(gudhi, "SimplexTree", lambda: trees.append(1) or make())
    jax.block_until_ready(jax.vmap(lambda s: diagrams_of_strips(s, GUDHI))(strips_of(5)))
    assert len(trees) == 1


def test_gradients_are_the_same_from_both_backends() -> None:
    strips = strips_of(3)
    weights = np.random.default_rng(3).random((3, 7, 31)).astype(np.float32)

    def loss(low: jax.Array, high: jax.Array, config: thor2.DescriptorConfig) -> jax.Array:
        moved = thor2.Strips(low, high, strips.occupied, strips.color, strips.overflow)
        return (diagrams_of_strips(moved, config).deaths * weights).sum()

    for config in (GUDHI, CLOSED):
        gradient = jax.jit(jax.grad(loss, argnums=(0, 1)), static_argnums=2)
        low, high = gradient(strips.low, strips.high, config)
        np.testing.assert_allclose(high, np.where(strips.occupied, weights, 0), atol=1e-7)
        np.testing.assert_allclose(low, -np.where(strips.occupied, weights, 0), atol=1e-7)
