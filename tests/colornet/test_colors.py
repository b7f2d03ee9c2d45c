"""CIELAB against reference formulas, and the region weights of 8-bit colours."""

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray

import colornet
from colornet.colors import GRID_WHITE, MEAN_WHITE, grid_colors, to_lab

NETWORK = colornet.load_default()
COLORS = hnp.arrays(np.uint8, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5).map(lambda s: (*s, 3)))


def reference_lab(rgb: NDArray[np.generic], white: tuple[float, float]) -> NDArray[np.float64]:
    """Return CIELAB by the formulas of IEC 61966-2-1 and CIE 15."""
    encoded = np.asarray(rgb, np.float64) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    matrix = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y = white
    ratio = linear @ matrix.T / np.array([x / y, 1.0, (1 - x - y) / y])
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


@pytest.mark.parametrize("white", [GRID_WHITE, MEAN_WHITE])
def test_lab(white: tuple[float, float]) -> None:
    for colors in (grid_colors(), np.array([12.25, 200.5, 99.125]), np.zeros((0, 3))):
        np.testing.assert_allclose(to_lab(colors, white), reference_lab(colors, white), atol=1e-9)
    assert str(np.ones(1)) == "[1.]"  # colour-science changes it when it is imported


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
