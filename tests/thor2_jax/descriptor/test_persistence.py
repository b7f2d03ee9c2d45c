"""Diagrams of both backends against one gudhi tree for each slice; images against persim and Gaussians."""

import dataclasses

import gudhi
import jax
import jax.numpy as jnp
import numpy as np
import persim
import pytest
from small_clouds import aligned_cloud

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.persistence import diagrams_of_strips, persistence_images
from thor2_jax.testing.values import cells, pixel_masses

GUDHI, CLOSED = thor2.DescriptorConfig(), thor2.DescriptorConfig(homology="closed_form")


def plain_pairs(points: np.ndarray) -> list[np.ndarray]:
    """Return the finite H0 pairs of each slice, [k, 2] sorted: each strip is two vertices and an edge of a complex."""
    i, j = cells(points, GUDHI)
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


def pack(clouds: list[np.ndarray], capacity: int | None = None) -> thor2.PointClouds:
    return thor2.PointClouds.pack([(points, np.zeros(points.shape)) for points in clouds], capacity)


@pytest.mark.parametrize("config", [GUDHI, CLOSED], ids=["gudhi", "closed_form"])
def test_pairs_against_one_tree_per_slice(config: thor2.DescriptorConfig) -> None:
    clouds = [aligned_cloud(k, n)[0] for k, n in enumerate((0, 1, 2, 3, 50, 333, 512, 511))]
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
    trees, make = [], gudhi.SimplexTree
    strips = thor2.strips(pack([aligned_cloud(k, 50)[0] for k in range(5)]), colornet.load_default(), GUDHI)
    monkeypatch.setattr(gudhi, "SimplexTree", lambda: trees.append(1) or make())
    jax.block_until_ready(jax.vmap(lambda each: diagrams_of_strips(each, GUDHI))(strips))
    assert len(trees) == 1


TOLERANCE = 1e-6
"""Deaths are rounded by 6e-8, which the narrow Gaussian amplifies; pixels reach 0.2."""


def imager() -> persim.PersistenceImager:
    """Return an imager with the window of the paper, set after `pixel_size`, which moves it; `sigma` is a variance."""
    result = persim.PersistenceImager(
        birth_range=(0, 0.75),
        pers_range=(0, 0.75),
        kernel_params={"sigma": [[0.00025, 0.0], [0.0, 0.00025]]},
        weight="persistence",
        weight_params={"n": 1.0},
    )
    result.pixel_size = 0.025
    result.birth_range = result.pers_range = (-0.025, 0.775)
    return result


def strip_of(births: np.ndarray) -> np.ndarray:
    return np.rint(np.asarray(births) / 0.025).astype(int)


def diagram(births: np.ndarray, deaths: np.ndarray, n_strips: int = 31) -> thor2.Diagrams:
    """Return the diagram of one slice, each pair at the index of its strip; other values are not to be used."""
    out, mask = np.full((2, n_strips), [[0.3], [0.6]], np.float32), np.zeros(n_strips, bool)
    out[:, strip_of(births)], mask[strip_of(births)] = (births, deaths), True
    return thor2.Diagrams(jnp.asarray(out[0]), jnp.asarray(out[1]), jnp.asarray(mask))


def random_pairs(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    births = rng.choice(31, n, replace=False) * 0.025
    return births, births + rng.random(n) * 0.8


@pytest.mark.parametrize("n", [1, 2, 7, 31])
def test_against_persim(n: int) -> None:
    births, deaths = random_pairs(n, n)
    image = jax.jit(persistence_images, static_argnums=1)(diagram(births, deaths), GUDHI)
    expected = imager().transform(np.stack([births, deaths], axis=1), skew=True)
    assert expected.shape == image.shape == (32, 32)
    np.testing.assert_allclose(image, expected, atol=TOLERANCE)


@pytest.mark.parametrize("size", [17, 32])
@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("variance", [0.00025, 0.001])
def test_sizes_weights_and_variances(size: int, exponent: float, variance: float) -> None:
    births, deaths = random_pairs(4, 9)
    config = dataclasses.replace(GUDHI, image_size=size, image_variance=variance)
    across, up = (pixel_masses(centres, config) for centres in (births, deaths - births))
    expected = np.einsum("kp,kq,k->pq", across, up, (deaths - births) ** exponent)
    sized = dataclasses.replace(GUDHI, image_size=size)
    image = persistence_images(diagram(births, deaths), sized, variance, exponent)
    np.testing.assert_allclose(image, expected, atol=TOLERANCE)
