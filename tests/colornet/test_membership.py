"""Region weights of 8-bit colours."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given

import colornet
from colornet.colors import grid_colors

NETWORK = colornet.load_default()
COLORS = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5).map(lambda s: (*s, 3)))


def reference_weights(color: list[int]) -> list[float]:
    r, g, b = (int(round(channel / 5)) for channel in color)
    bits = int(NETWORK.region_bits[(r * 52 + g) * 52 + b])
    regions = [k for k in range(22) if bits >> k & 1]
    return [1 / len(regions) if k in regions else 0.0 for k in range(22)]


@given(COLORS)
def test_weights(rgb: np.ndarray) -> None:
    before = rgb.copy()
    weights = NETWORK.membership(rgb)
    assert weights.shape == (*rgb.shape[:-1], 22) and weights.dtype == np.float32
    np.testing.assert_array_equal(rgb, before)
    expected = [reference_weights(color) for color in rgb.reshape(-1, 3).tolist()]
    np.testing.assert_allclose(weights.reshape(-1, 22), np.reshape(expected, (-1, 22)), rtol=1e-7)


def test_every_grid_color_has_a_region() -> None:
    colors = grid_colors()
    assert colors.dtype == np.uint8
    np.testing.assert_array_equal(colors, 5 * np.array(list(np.ndindex(52, 52, 52))))
    np.testing.assert_array_equal(colornet.grid_index(colors), np.arange(52**3))
    weights = NETWORK.membership(colors)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, atol=1e-6)
    np.testing.assert_array_equal((weights > 0).sum(axis=0), NETWORK.member_counts)


def test_invalid_input_is_rejected() -> None:
    for rgb in (np.zeros((4, 3)), np.zeros((4, 3), bool), np.zeros((4, 4), np.uint8), np.uint8(3), [[1, 2, 3]]):
        with pytest.raises(ValueError, match=r"^rgb is .*; expected uint8 \[\.\.\., 3\]$"):
            NETWORK.membership(rgb)
