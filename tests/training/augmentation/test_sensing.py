"""Noise, smoothing, missing and flying pixels of the depth sensor, against the statistics that they should have."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from training.augmentation.sensing import Sensor, sensed
from training.rendering.camera import RenderedView

from .conftest import augmented_view, flat_view, wall

NO_SENSOR = Sensor(axial=(0, 0), lateral=0, missing=0, flying=0, smooth=(0, 0), patches=(0, 0))


def sensed_depth(view: RenderedView, **settings: Any) -> np.ndarray:
    """Return the depth of a view from a sensor that has only the effects of these settings."""
    return sensed(view, dataclasses.replace(NO_SENSOR, **settings), np.random.default_rng(0)).depth


@pytest.mark.parametrize("z", [0.5, 2.0])
def test_noise_along_the_axis(z: float) -> None:
    depth = sensed_depth(flat_view(wall(size=150)), distance=(z, z), axial=(1, 1))
    assert depth.mean() == pytest.approx(1500, abs=0.1) and (depth > 0).all()
    # Nguyen, Izadi and Lovell 2012, in millimetres; rounding adds 1 / 12.
    assert depth.std() == pytest.approx(np.hypot(1.2 + 1.9 * (z - 0.4) ** 2, 1 / np.sqrt(12)), rel=0.03)


def test_noise_across_the_axis() -> None:
    """On a plane that recedes by 1 mm per pixel, lateral noise appears as noise of the depth."""
    pixel, inside = 1.5 / 1099, np.s_[20:-20, 20:-20]
    right = np.tile(np.arange(1400, 1600, dtype=np.uint16), (200, 1))
    for depth in (right, right.T.copy()):
        noisy = augmented_view(flat_view(depth), 0, sensor=dataclasses.replace(NO_SENSOR, lateral=2.0)).depth[inside]
        deviation = (noisy.astype(float) - depth[inside]).std()
        expected = np.hypot(2.0 * 0.001 / pixel, 1 / np.sqrt(12))
        assert (noisy > 0).all() and deviation == pytest.approx(expected, rel=0.05)


def test_missing_pixels_on_edges() -> None:
    """Pixels are missing only at a step, at the outline and on steep surfaces."""
    depth = wall(size=300, margin=5)
    depth[:, 155:] += np.uint16(100) * (depth[:, 155:] > 0)
    lost = (sensed_depth(flat_view(depth), missing=0.3) == 0) & (depth > 0)
    edge = np.zeros(depth.shape, bool)
    edge[[5, -6], 5:-5] = edge[5:-5, [5, -6]] = edge[5:-5, 154:156] = True
    assert lost[edge].mean() == pytest.approx(0.3, abs=0.04) and not lost[~edge].any()
    # 4 mm per pixel correspond to 71 degrees, and 8 mm to 80 degrees.
    for step, share in ((4, 0.0), (8, 0.3)):
        steep = np.tile((1000 + step * np.arange(100)).astype(np.uint16), (100, 1))
        noisy = sensed_depth(flat_view(steep), missing=0.3)
        assert (noisy[1:-1, 1:-1] == 0).mean() == pytest.approx(share, abs=0.02)


def test_flying_pixels() -> None:
    """Flying pixels lie at the outline, between surface and background; most are removed as by outlier removal."""
    flying: dict[str, Any] = {"flying": 0.5, "background": (0.4, 0.4)}
    view = flat_view(wall(size=300, margin=3))
    moved = sensed_depth(view, **flying).astype(int) - view.depth
    edge = (view.depth > 0) & ~binary_erosion(view.depth > 0)
    assert not moved[~edge].any()
    behind = moved[edge & (moved != 0)]
    assert len(behind) / edge.sum() == pytest.approx(0.5, abs=0.05)
    assert 0 < behind.min() and behind.max() <= 400 and behind.mean() == pytest.approx(200, abs=15)
    fewer = sensed_depth(view, missing=0.5, **flying)
    assert (fewer[edge] > view.depth[edge]).mean() == pytest.approx(0.25, abs=0.04)  # half of those that are left
    left = augmented_view(view, 0, sensor=dataclasses.replace(NO_SENSOR, **flying))
    drop = 15 * 1500 / 1099  # smallest step in depth that outlier removal detects, mm
    sides = left.depth.copy()
    sides[np.ix_([3, -4], [3, -4])] = 0  # both neighbours of a corner may be flying pixels
    assert sides.max() <= 1500 + 2 * drop
    assert ((view.depth > 0) & (left.depth == 0)).sum() == pytest.approx(len(behind) * (1 - drop / 400), rel=0.1)


def test_smoothing_correlates_noise() -> None:
    """White noise behind a Gaussian of standard deviation s has 1 / (2 s sqrt(pi)) of its standard deviation."""
    view = flat_view(wall(size=200), f=750.0)  # pixels are 2 mm wide, twice as wide as in a real frame
    depth = sensed_depth(view, distance=(3, 3), axial=(1, 1), smooth=(4, 4)).astype(float)
    noise = (1.2 + 1.9 * (3 - 0.4) ** 2) / (4 * np.sqrt(np.pi))
    assert depth.min() > 1400 and depth[10:-10, 10:-10].std() == pytest.approx(np.hypot(noise, 0.289), rel=0.1)
    between = np.corrcoef(depth[10:-10, 10:-11].ravel(), depth[10:-10, 11:-10].ravel())[0, 1]
    assert between == pytest.approx(np.exp(-1 / 16), abs=0.08)


def test_depth_is_missing_in_patches() -> None:
    lost = sensed_depth(flat_view(wall(size=200), f=750.0), patches=(0.2, 0.2), patch=(8, 8)) == 0
    assert lost.mean() == pytest.approx(0.2, abs=0.02)
    assert 2 < lost.sum() / (lost & ~binary_erosion(lost)).sum() < 5  # of single pixels, all would be borders
