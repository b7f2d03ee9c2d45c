"""Operations on images of pixels, compared with NumPy and SciPy."""

import numpy as np
import pytest
from scipy import ndimage

pytest.importorskip("cv2")

from thor2_jax.segmentation.pixels import components, label_borders, nearest_known


def random_mask(shape: tuple[int, int] = (60, 90), seed: int = 0) -> np.ndarray:
    return ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2) > 0


def test_components_are_connected_parts() -> None:
    mask = random_mask()
    numbers, sizes = components(mask)
    expected, count = ndimage.label(mask)
    pairs = np.unique(np.stack([numbers[mask], expected[mask]]), axis=1)
    assert pairs.shape[1] == count == len(sizes) - 1 > 5
    assert np.array_equal(sizes[1:], np.bincount(numbers[mask])[1:]) and sizes[0] == 0


def test_the_nearest_known_pixel_is_nearest() -> None:
    known = random_mask(seed=1)
    nearest = np.argwhere(known)[nearest_known(known)]
    pixels = np.stack(np.indices(known.shape), axis=-1)
    distance = np.linalg.norm(nearest - pixels, axis=-1)
    exact = ndimage.distance_transform_edt(~known)
    assert np.all(distance[known] == 0) and exact.max() > 5
    assert np.all(distance <= 1.1 * exact)  # OpenCV adds up steps to the neighbours of a pixel


@pytest.mark.parametrize("largest", [5, 300])
def test_borders_have_two_labels_around(largest: int) -> None:
    labels = np.where(random_mask(), largest, 1).astype(np.int32)
    low, high = (f(labels, size=3, mode="nearest") for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    assert np.array_equal(label_borders(labels, 3), low != high)
