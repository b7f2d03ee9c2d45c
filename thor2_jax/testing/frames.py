"""Hypothesis strategies for RGB-D frames, and properties of instance clouds."""

from collections.abc import Callable, Sequence

import hypothesis.strategies as st
import numpy as np

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.instance_clouds import InstanceCloud
from thor2_jax.testing.clouds import seeds

__all__ = ["assert_depth_units_agree", "assert_labels_are_names", "frames"]

Clouds = Callable[[RGBDFrame], Sequence[InstanceCloud]]


def _frame(seed: int, height: int, width: int, n_objects: int) -> RGBDFrame:
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[:height, :width]
    depth = 0.9 + 0.2 * row / height + rng.normal(scale=0.001, size=(height, width))
    labels = np.zeros((height, width), np.uint8)
    color = np.full((height, width, 3), rng.integers(0, 256, 3), np.uint8)
    for number in rng.choice(np.arange(1, 256), n_objects, replace=False):
        centre, radius = rng.uniform([0, 0], [height, width]), rng.uniform(0.1, 0.4, 2) * [height, width]
        inside = ((row - centre[0]) / radius[0]) ** 2 + ((column - centre[1]) / radius[1]) ** 2
        here = inside < 1
        depth[here] = rng.uniform(0.5, 0.8) - 0.05 * np.sqrt(1 - inside[here])
        labels[here] = number
        color[here] = rng.integers(0, 256, 3)
    depth[rng.random(depth.shape) < 0.02] = 0
    focal = rng.uniform(0.8, 2) * width
    intrinsics = Intrinsics(focal, focal * rng.uniform(0.98, 1.02), (width - 1) / 2, (height - 1) / 2)
    return RGBDFrame(color, np.rint(depth * 1000).astype(np.uint16), labels, intrinsics)


def frames(max_side: int = 120, max_objects: int = 5) -> st.SearchStrategy[RGBDFrame]:
    """Generate frames of ellipsoids in front of a slanted plane; some are occluded or cut by the border.

    Depth is in millimetres, uint16, with missing values; labels are uint8 and not consecutive.

    Args:
        max_side: largest height and width in pixels, at least 8.
        max_objects: largest number of instances; later ones occlude earlier ones.
    """
    side = st.integers(8, max_side)
    return st.builds(_frame, seeds(), side, side, st.integers(0, max_objects))


def assert_labels_are_names(instance_clouds: Clouds, frame: RGBDFrame, seed: int) -> None:
    """Assert that other label numbers give the same clouds, bit by bit."""
    numbers = np.random.default_rng(seed).permutation(np.arange(1, 256))
    other = np.concatenate([[0], numbers]).astype(np.uint16)
    clouds = {
        c.label: c
        for c in instance_clouds(RGBDFrame(frame.color, frame.depth, other[frame.label_image], frame.intrinsics))
    }
    for cloud in instance_clouds(frame):
        same = clouds.pop(int(other[cloud.label]))
        assert (same.n_pixels, same.kept_by_fallback, same.reason) == (
            cloud.n_pixels,
            cloud.kept_by_fallback,
            cloud.reason,
        )
        np.testing.assert_array_equal(same.points, cloud.points)
        np.testing.assert_array_equal(same.colors, cloud.colors)
    assert not clouds


def assert_depth_units_agree(instance_clouds: Clouds, frame: RGBDFrame) -> None:
    """Assert that depth in integer units and in metres gives the same clouds, bit by bit."""
    other = RGBDFrame(frame.color, frame.depth_m, frame.label_image, frame.intrinsics)
    for first, second in zip(instance_clouds(frame), instance_clouds(other), strict=True):
        assert first.reason == second.reason
        np.testing.assert_array_equal(first.points, second.points)
        np.testing.assert_array_equal(first.colors, second.colors)
