"""Rounding to slices, strips and colour regions, against NumPy in float64."""

import jax
import numpy as np
from small_clouds import NETWORK

import thor2_jax as thor2
from thor2_jax.descriptor.slicing import color_sets, region_sets, slices_and_strips
from thor2_jax.testing.values import cells

RELEASED = thor2.DescriptorConfig.released()


@jax.jit
def released_indices(points: np.ndarray, mask: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Return the slices and the strips of points [N, 3] by the released rule."""
    return slices_and_strips(points[:, 0], points[:, 2], mask, RELEASED)


def test_the_released_rounding_at_every_half() -> None:
    """Tests the floats at and next to each half of 0.01 and 0.1, where a product in single precision rounds wrongly."""
    x = np.concatenate([(np.arange(79) + 0.5) / 100, np.arange(78) / 100]).astype(np.float32)
    z = np.concatenate([(np.arange(12) + 0.5) / 10, np.arange(13) / 10]).astype(np.float32)
    for column, values in ((0, x), (2, z)):
        near = [values, np.nextafter(values, np.float32(9)), np.nextafter(values, np.float32(-9))]
        points = np.zeros((3 * len(values), 3), np.float32)
        points[:, column] = np.maximum(np.concatenate(near), 0)
        indices = released_indices(points, np.ones(len(points), bool))
        slices, strips = cells(points, RELEASED)
        np.testing.assert_array_equal(indices[0], slices)
        np.testing.assert_array_equal(np.minimum(indices[1], 31), strips)


def test_padding_does_not_occupy_levels_in_the_released_rule() -> None:
    points = np.array([[0.1, 0.1, 0.4], [0.2, 0.2, 0.6], [0, 0, 0]], np.float32)
    i, _ = released_indices(points, np.array([True, True, False]))
    np.testing.assert_array_equal(i[:2], [0, 1])


def test_levels_past_twice_the_slices_overflow_if_released() -> None:
    """For any rank, 1.3 is the last level that counts, and 1.4 the first that does not."""
    for far, number in ((1.3, 1), (1.4, 14)):
        i, _ = released_indices(np.array([[0.1, 0.1, 0], [0.1, 0.1, far]], np.float32), np.ones(2, bool))
        np.testing.assert_array_equal(i, [0, number])


def test_every_level_of_a_channel_and_every_half_between_two() -> None:
    """Means of two 8-bit colours lie between two levels, where single precision decides the rounding."""
    halves = (np.arange(511) / 510).astype(np.float32)
    values = np.concatenate([halves, np.nextafter(halves, np.float32(0)), np.nextafter(halves, np.float32(1))])
    sets = region_sets(NETWORK)
    for axis in range(3):
        colors = np.full((len(values), 3), 0.5, np.float32)
        colors[:, axis] = values
        eight_bit = np.floor(colors * np.float32(255) + np.float32(0.5)).astype(np.uint8)
        weights = sets.weights[jax.jit(color_sets)(colors, sets)]
        np.testing.assert_array_equal(weights, NETWORK.membership(eight_bit))
