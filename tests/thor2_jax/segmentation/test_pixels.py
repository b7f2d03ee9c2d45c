"""Floods and nearest pixels, compared with NumPy and SciPy; scenes on a table test the other operations on pixels."""

import numpy as np
from scipy import ndimage

from thor2_jax.segmentation.pixels import nearest_known, watershed

MASK = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(60, 90)), 2) > 0


def test_the_nearest_known_pixel_is_nearest() -> None:
    nearest = np.argwhere(MASK)[nearest_known(MASK)]
    distance = np.linalg.norm(nearest - np.stack(np.indices(MASK.shape), axis=-1), axis=-1)
    exact = ndimage.distance_transform_edt(~MASK)
    assert np.all(distance[MASK] == 0) and exact.max() > 5
    assert np.all(distance <= 1.1 * exact)  # OpenCV adds up steps to the neighbours of a pixel


def test_a_flood_ends_at_the_edge_of_two_colors() -> None:
    color, markers = np.full((20, 30, 3), 200, np.uint8), np.zeros((20, 30), np.int32)
    color[:, 12:] = (30, 60, 190)
    markers[:, 2], markers[:, 25] = 4, 7
    flooded, expected = watershed(color, markers), np.where(np.arange(30) < 12, 4, 7)
    np.testing.assert_array_equal(
        np.delete(flooded, [11, 12], axis=1), np.delete(np.tile(expected, (20, 1)), [11, 12], axis=1)
    )
    assert np.isin(flooded, (4, 7)).all() and markers.sum() == 20 * 11
