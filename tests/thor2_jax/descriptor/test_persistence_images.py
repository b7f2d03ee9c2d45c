"""Persistence images against persim, and against a quadrature of the Gaussian."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import persim
import pytest
from scipy.special import ndtr

import thor2_jax as thor2
from thor2_jax.descriptor.persistence import persistence_images

CONFIG = thor2.DescriptorConfig()
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


def expected_image(
    births: np.ndarray, deaths: np.ndarray, size: int = 32, variance: float = 0.00025, exponent: float = 1.0
) -> np.ndarray:
    """Return the image by normal distributions in float64."""
    edges, persistence = (np.arange(size + 1) - 1) * 0.025, deaths - births
    across, up = (np.diff(ndtr((edges - centre[:, None]) / np.sqrt(variance))) for centre in (births, persistence))
    return np.einsum("kp,kq,k->pq", across, up, persistence**exponent)


@pytest.mark.parametrize("n", [1, 2, 7, 31])
def test_against_persim(n: int) -> None:
    births, deaths = random_pairs(n, n)
    image = jax.jit(persistence_images, static_argnums=1)(diagram(births, deaths), CONFIG, 0.00025, 1.0)
    expected = imager().transform(np.stack([births, deaths], axis=1), skew=True)
    assert expected.shape == image.shape == (32, 32)
    np.testing.assert_allclose(image, expected, atol=TOLERANCE)


@pytest.mark.parametrize("size", [17, 32])
@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("variance", [0.00025, 0.001])
def test_sizes_weights_and_variances(size: int, exponent: float, variance: float) -> None:
    births, deaths = random_pairs(4, 9)
    expected = expected_image(births, deaths, size, variance, exponent)
    sized = dataclasses.replace(CONFIG, image_size=size)
    image = persistence_images(diagram(births, deaths), sized, variance, exponent)
    np.testing.assert_allclose(image, np.broadcast_to(expected, image.shape), atol=TOLERANCE)
