"""Helpers of the augmentations: ranges of settings, and pixels of a view."""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from training.rendering.view_sphere import RenderedView

__all__ = ["FRAME_PIXEL", "Range", "blurred", "pixel_width", "without"]

FRAME_PIXEL = 0.001
"""Width of a pixel of a real frame on the object, metres (f = 616 pixels at 0.6 m, 920 at 0.9 m, 1,067 at 1.1 m).
A pixel of a training view is 1.4 mm wide."""


TRUNCATE = 2.5
"""Reach of the Gaussians, in standard deviations: beyond it lies about 1 % of their weight."""


def pixel_width(view: RenderedView) -> float:
    """Return the width of a pixel on the object, metres, at the mean depth; at least one pixel must have depth."""
    return float(view.depth.sum() / np.count_nonzero(view.depth)) / 1000 / view.intrinsics.fx


def blurred(values: NDArray[np.float32], seen: NDArray[np.bool_], deviation: float) -> NDArray[np.float32]:
    """Return `values` [h, w] or [h, w, c] blurred by a Gaussian over the pixels `seen` [h, w]; others do not count.

    Args:
        values: 0 outside of `seen`.
        seen: pixels with depth.
        deviation: standard deviation of the Gaussian, pixels.
    """
    weight = gaussian_filter(seen.astype(np.float32), deviation, truncate=TRUNCATE)
    result = gaussian_filter(values, (deviation, deviation, 0)[: values.ndim], truncate=TRUNCATE)
    return np.asarray(result / np.maximum(weight, np.float32(1e-3)).reshape(seen.shape + (1,) * (values.ndim - 2)))


def without(view: RenderedView, pixels: NDArray[np.intp]) -> RenderedView:
    """Return the view without `pixels`, flat indices [n]."""
    color, depth = view.color.copy(), view.depth.copy()
    color.reshape(-1, 3)[pixels] = 0
    depth.reshape(-1)[pixels] = 0
    return dataclasses.replace(view, color=color, depth=depth)


Range = tuple[float, float]
"""Smallest and largest value of a uniform distribution."""
