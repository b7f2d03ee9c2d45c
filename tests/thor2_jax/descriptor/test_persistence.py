"""The callback of gudhi, and images of other sizes, weights and variances; tests/golden tests those of the paper."""

import dataclasses

import gudhi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_clouds import aligned_cloud

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.persistence import diagrams_of_strips, persistence_images
from thor2_jax.testing.values import pixel_masses

GUDHI = thor2.DescriptorConfig()


def test_one_callback_per_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    trees, make = [], gudhi.SimplexTree
    clouds = thor2.PointClouds.pack([aligned_cloud(k, 50) for k in range(5)])
    strips = thor2.strips(clouds, colornet.load_default(), GUDHI)
    monkeypatch.setattr(gudhi, "SimplexTree", lambda: trees.append(1) or make())
    jax.block_until_ready(jax.vmap(lambda each: diagrams_of_strips(each, GUDHI))(strips))
    assert len(trees) == 1


TOLERANCE = 1e-6
"""Deaths are rounded by 6e-8, which the narrow Gaussian amplifies; pixels reach 0.2."""


@pytest.mark.parametrize("size", [17, 32])
@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("variance", [0.00025, 0.001])
def test_sizes_weights_and_variances(size: int, exponent: float, variance: float) -> None:
    rng = np.random.default_rng(4)
    strip, heights = rng.choice(31, 9, replace=False), rng.random(9) * 0.8
    births = strip * 0.025
    fields, mask = np.full((2, 31), [[0.3], [0.6]], np.float32), np.isin(np.arange(31), strip)
    fields[:, strip] = births, births + heights  # values of other strips are not to be used
    config = dataclasses.replace(GUDHI, image_size=size, image_variance=variance)
    across, up = (pixel_masses(centres, config) for centres in (births, heights))
    expected = np.einsum("kp,kq,k->pq", across, up, heights**exponent)
    sized = dataclasses.replace(GUDHI, image_size=size)
    diagram = thor2.Diagrams(*jnp.asarray(fields), jnp.asarray(mask))
    image = jax.jit(persistence_images, static_argnums=1)(diagram, sized, variance, exponent)
    np.testing.assert_allclose(image, expected, atol=TOLERANCE)
