"""The callback of gudhi, and images of other sizes, weights and variances; golden files have those of the paper."""

import dataclasses

import gudhi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_clouds import NETWORK, aligned_cloud

import thor2_jax as thor2
from thor2_jax.descriptor.persistence import diagrams_of_strips, persistence_images
from thor2_jax.testing.values import pixel_masses

GUDHI = thor2.DescriptorConfig()


def test_one_callback_per_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    trees, make = [], gudhi.SimplexTree
    clouds = thor2.PointClouds.pack([aligned_cloud(k, 50) for k in range(5)])
    strips = thor2.strips(clouds, NETWORK, GUDHI)
    monkeypatch.setattr(gudhi, "SimplexTree", lambda: trees.append(1) or make())
    jax.block_until_ready(jax.vmap(lambda each: diagrams_of_strips(each, GUDHI))(strips))
    assert len(trees) == 1


@pytest.mark.parametrize("size", [17, 32])
@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("variance", [0.00025, 0.001])
def test_sizes_weights_and_variances(size: int, exponent: float, variance: float) -> None:
    rng = np.random.default_rng(4)
    strips = rng.choice(31, 9, replace=False)
    births, deaths = np.full((2, 31), [[0.3], [0.6]])  # those outside of the mask are not to be used
    births[strips] = 0.025 * strips
    deaths[strips] = births[strips] + rng.random(9) * 0.8
    mask = np.isin(np.arange(31), strips)
    config = dataclasses.replace(GUDHI, image_size=size, image_variance=variance)
    across, up = (pixel_masses(centres, config) for centres in (births, deaths - births))
    expected = np.einsum("kp,kq,k->pq", across, up, np.where(mask, deaths - births, 0) ** exponent)
    diagram = thor2.Diagrams(*(jnp.asarray(a, jnp.float32) for a in (births, deaths)), jnp.asarray(mask))
    image = persistence_images(diagram, dataclasses.replace(GUDHI, image_size=size), variance, exponent)
    np.testing.assert_allclose(image, expected, atol=1e-6)  # rounding of deaths, amplified by the narrow Gaussian
