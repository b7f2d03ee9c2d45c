"""CIELAB, HyAB and HyAB neighbourhoods against reference formulas and brute force."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from sklearn.cluster import DBSCAN

from colornet.builder import EPS, MIN_SAMPLES, HyabDBSCAN, hyab_neighbors, lens
from colornet.colors import GRID_WHITE, MEAN_WHITE, grid_colors, to_lab


def reference_lab(rgb: NDArray[np.generic], white: tuple[float, float]) -> NDArray[np.float64]:
    """Return CIELAB by the formulas of IEC 61966-2-1 and CIE 15."""
    encoded = np.asarray(rgb, np.float64) / 255
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    matrix = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y = white
    ratio = linear @ matrix.T / np.array([x / y, 1.0, (1 - x - y) / y])
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def reference_hyab(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(abs(one[0] - other[0]) + ((one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2) ** 0.5)


@pytest.fixture(scope="module")
def lab() -> NDArray[np.float64]:
    """Two blocks of similar colours and some random ones, in CIELAB."""
    colors = grid_colors()
    rows = np.random.default_rng(0).choice(len(colors), 200, replace=False)
    for center in ([180, 90, 60], [40, 60, 200]):
        near = np.flatnonzero((np.abs(colors.astype(int) - center) <= 15).all(axis=1))[:200]
        rows = np.union1d(rows, near)
    return to_lab(colors[rows], GRID_WHITE)


@pytest.mark.parametrize("white", [GRID_WHITE, MEAN_WHITE])
def test_lab(white: tuple[float, float]) -> None:
    for colors in (grid_colors(), np.array([12.25, 200.5, 99.125]), np.zeros((0, 3))):
        np.testing.assert_allclose(to_lab(colors, white), reference_lab(colors, white), atol=1e-9)


def test_neighborhoods_equal_those_of_brute_force(lab: NDArray[np.float64]) -> None:
    distances = cdist(lab, lab, reference_hyab)
    near = (distances <= EPS) & ~np.eye(len(lab), dtype=bool)
    neighbors = hyab_neighbors(lab, EPS).toarray()
    assert near.sum() > 1000
    np.testing.assert_array_equal(neighbors > 0, near)
    np.testing.assert_allclose(neighbors[near], distances[near], atol=1e-12)


def test_neighborhoods_on_the_border_of_the_ball() -> None:
    """For differences in lightness only, HyAB, the Euclidean distance and the radius are equal."""
    lab = np.array([[10.0, 3.0, 4.0], [17.0, 3.0, 4.0], [17.1, 3.0, 4.0], [24.1, 3.0, 4.0]])
    neighbors = hyab_neighbors(lab, 7.0).toarray() > 0
    expected = np.abs(lab[:, None, 0] - lab[None, :, 0]) <= 7.0
    np.testing.assert_array_equal(neighbors, expected & ~np.eye(4, dtype=bool))


def test_clusters_equal_those_of_a_dense_matrix(lab: NDArray[np.float64]) -> None:
    dense = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, metric="precomputed").fit_predict(cdist(lab, lab, reference_hyab))
    labels = HyabDBSCAN().fit_predict(lab)
    assert labels.max() >= 1 and labels.min() == -1
    np.testing.assert_array_equal(labels, dense)


def test_lens() -> None:
    values = lens(np.array([[50.0, 3.0, 4.0], [50.0, -1.0, 0.0], [0.0, 0.0, 0.0]]))
    expected = [[5.0, np.pi / 8 + np.arctan(4 / 3)], [1.0, np.pi / 8 + np.pi], [0.0, np.pi / 8]]
    np.testing.assert_allclose(values, expected, atol=1e-15)
