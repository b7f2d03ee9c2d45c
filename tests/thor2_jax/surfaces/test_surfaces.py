"""Surfaces of classes: their file, and distances from them."""

import jax
import numpy as np

from thor2_jax.surfaces.surfaces import Surfaces
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of


def test_content() -> None:
    surfaces = surfaces_of([builtin_objects()["banana"]])
    again = Surfaces.of_content(surfaces.content)
    jax.tree.map(np.testing.assert_array_equal, again, surfaces)
    assert again.content == surfaces.content
    kinds, expected = ([(a.shape, a.dtype) for a in each.arrays.values()] for each in (Surfaces.empty(), surfaces))
    assert kinds == expected


def test_distances_from_a_surface_of_one_point() -> None:
    """Beside the point, a third of the distance counts."""
    table = np.zeros((1, 9, 1), np.float32)
    table[0, 8] = 1
    grid = np.array([[[-0.1] * 3, [0.2 / 48] * 3]], np.float32)
    one = Surfaces(table, np.zeros((1, 48**3), np.int16), grid, np.zeros((1, 216, 3, 3), np.float32))
    points = np.array([[0.009, 0, 0], [0, 0, 0.004], [0, 0.03, 0.01], [0.11, 0, 0], [-0.11, 0, 0]])
    expected = [0.003, 0.004 * 10**0.5 / 3, np.hypot(0.01, np.hypot(0.03, 0.01) / 3), np.inf, np.inf]
    np.testing.assert_allclose(one.distances(0, np.eye(3, 4, dtype=np.float32), points), expected, rtol=1e-5)
