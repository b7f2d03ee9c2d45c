"""Floods at the edge of two colours; scenes on a table test the other operations on pixels."""

import numpy as np

from thor2_jax.segmentation.pixels import watershed


def test_a_flood_ends_at_the_edge_of_two_colors() -> None:
    color, markers = np.full((20, 30, 3), 200, np.uint8), np.zeros((20, 30), np.int32)
    color[:, 12:] = (30, 60, 190)
    markers[:, 2], markers[:, 25] = 4, 7
    flooded, expected = watershed(color, markers), np.where(np.arange(30) < 12, 4, 7)
    np.testing.assert_array_equal(
        np.delete(flooded, [11, 12], axis=1), np.delete(np.tile(expected, (20, 1)), [11, 12], axis=1)
    )
    assert np.isin(flooded, (4, 7)).all() and markers.sum() == 20 * 11
