"""Edges of a depth image: steps, where a surface ends in front of another, and folds, where two surfaces form a dent.

Both are found by extrapolation. In inverse depth a plane is linear, so the value two pixels after an edge is compared
with that extrapolated from two and six pixels before it, and the other way round. At a step the two differences have
opposite signs; at a fold both are positive, since both surfaces bend towards the camera.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from thor2_jax.segmentation.pixels import Mask, nearest_known
from thor2_jax.segmentation.planes import DepthImage

__all__ = ["depth_edges"]

STEP = (0.006, 0.015)
"""Least step: the first in metres, plus the second times the squared depth in metres."""

NARROW = 0.4
"""Least share of a step between the two neighbours of a pixel."""

BEND = 0.4
"""Least change of slope at a fold."""

NEAR, FAR = 2, 6
"""Pixels between an edge and the values that are extrapolated."""


def depth_edges(depth: DepthImage) -> tuple[Mask, Mask, Mask]:
    """Return the edges of a depth image.

    Returns:
        Steps along rows, steps along columns, and folds, [H, W] each.
    """
    known = depth.valid
    if not known.any():
        none = np.zeros(known.shape, bool)
        return none, none, none
    inverse = depth.inverse[known].take(nearest_known(known))
    inverse = np.asarray(cv2.medianBlur(inverse, 5))
    unknown = (~known).view(np.uint8)
    gap = np.asarray(cv2.dilate(cv2.distanceTransform(unknown, cv2.DIST_L2, 3), np.ones((3, 3), np.uint8)))
    # Metres are differences of inverse depth times the squared depth.
    least = STEP[0] * inverse * inverse + STEP[1]
    least_fold = 0.5 * least + (NEAR * BEND * depth.pixel_size) * inverse + gap
    steps, folds = [], np.zeros(known.shape, bool)
    for along_rows in (True, False):
        before, after, difference = (_filter(inverse, kernel, along_rows) for kernel in _kernels())
        smaller = np.minimum(np.abs(before), np.abs(after))
        opposite = (before > 0) != (after > 0)
        steps.append((smaller > least) & opposite & (np.abs(difference) > NARROW * least))
        folds |= np.minimum(before, after) > least_fold
    return steps[0], steps[1], folds


def _kernels() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return kernels: the value after a pixel minus its extrapolation, the same from the other side, a difference."""
    forward = np.zeros(2 * FAR + 1, np.float32)
    slope = 2 * NEAR / (FAR - NEAR)
    forward[FAR + NEAR] = 1
    forward[FAR - NEAR] = -1 - slope
    forward[0] = slope
    return forward, forward[::-1].copy(), np.array([-1, 0, 1], np.float32)


def _filter(image: NDArray[np.float32], kernel: NDArray[np.float32], along_rows: bool) -> NDArray[np.float32]:
    """Correlate with a kernel along rows or columns, averaged over three pixels across."""
    average = np.full(3, 1 / 3, np.float32)
    kernels = (kernel, average) if along_rows else (average, kernel)
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, *kernels))
