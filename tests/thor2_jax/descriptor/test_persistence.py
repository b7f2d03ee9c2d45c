"""Diagrams of both backends against one gudhi tree for each slice, built from the definition."""

import gudhi
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import colornet
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


def test_one_callback_per_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, trees, make = np.random.default_rng(1), [], gudhi.SimplexTree
    strips = thor2.strips(pack([random_cloud(rng, 50) for _ in range(5)]), colornet.load_default(), GUDHI)
    monkeypatch.setattr(gudhi, "SimplexTree", lambda: trees.append(1) or make())
    jax.block_until_ready(jax.vmap(lambda each: diagrams_of_strips(each, GUDHI))(strips))
    assert len(trees) == 1
