"""Region weights in JAX against those of the colour network, in NumPy."""

import jax
import numpy as np
from helpers import as_8_bit

import colornet
from thor2_jax.descriptor.slicing import color_sets, region_sets

NETWORK = colornet.load_default()


def weights(colors: np.ndarray) -> np.ndarray:
    sets = region_sets(NETWORK)
    return np.asarray(sets.weights[jax.jit(color_sets)(colors, sets)])


def test_every_level_of_a_channel_and_every_half_between_two() -> None:
    """Means of two 8-bit colours lie between two levels, where single precision decides the rounding."""
    halves = (np.arange(511) / 510).astype(np.float32)
    values = np.concatenate([halves, np.nextafter(halves, np.float32(0)), np.nextafter(halves, np.float32(1))])
    for axis in range(3):
        colors = np.full((len(values), 3), 0.5, np.float32)
        colors[:, axis] = values
        np.testing.assert_array_equal(weights(colors), NETWORK.membership(as_8_bit(colors)))


def test_floating_colours_in_any_shape() -> None:
    colors = np.random.default_rng(0).random((4, 5, 3)).astype(np.float32)
    region_weights = weights(colors)
    assert region_weights.shape == (4, 5, 22) and region_weights.dtype == np.float32
    np.testing.assert_array_equal(region_weights, NETWORK.membership(as_8_bit(colors)))
    np.testing.assert_allclose(region_weights.sum(axis=-1), 1, atol=1e-6)
