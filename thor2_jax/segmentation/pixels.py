"""Image operations of OpenCV with NumPy's types; masks are boolean images [H, W]."""

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.frames import RGBDFrame

__all__ = [
    "Mask",
    "close",
    "components",
    "enlarged",
    "filled",
    "grow",
    "label_borders",
    "nearest_known",
    "open_round",
    "pixel_mask",
    "renumbered",
    "shrink",
    "subsampled",
    "watershed",
    "window",
]

Mask = NDArray[np.bool_]

CROSS = np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)), np.uint8)
"""A cross with a width of three pixels."""


def _bytes(mask: Mask) -> NDArray[np.uint8]:
    return np.ascontiguousarray(mask).view(np.uint8)


def pixel_mask(image: object) -> Mask:
    """Return an OpenCV image of zeros and ones as a mask."""
    return np.asarray(image, np.uint8).view(np.bool_)


def grow(mask: Mask, size: int) -> Mask:
    """Return the mask dilated by a square of `size` pixels."""
    return pixel_mask(cv2.dilate(_bytes(mask), np.ones((size, size), np.uint8)))


def shrink(mask: Mask, size: int) -> Mask:
    """Return the mask eroded by a square of `size` pixels; the image border does not erode it."""
    return pixel_mask(cv2.erode(_bytes(mask), np.ones((size, size), np.uint8)))


def open_round(mask: Mask) -> Mask:
    """Return the mask opened with a cross of three pixels, which removes thinner parts."""
    return pixel_mask(cv2.morphologyEx(_bytes(mask), cv2.MORPH_OPEN, CROSS))


def close(mask: Mask, size: int) -> Mask:
    """Return the mask with gaps of less than `size` pixels closed."""
    return pixel_mask(cv2.morphologyEx(_bytes(mask), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)))


def components(mask: Mask, connectivity: int = 4) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
    """Return the numbers [H, W] of the connected components, 0 outside the mask, and their sizes in pixels.

    The size of number 0, the rest of the image, is 0.
    """
    numbers = np.asarray(cv2.connectedComponents(_bytes(mask), connectivity=connectivity)[1], np.int32)
    return numbers, np.bincount(numbers[mask], minlength=1)


def renumbered(numbers: NDArray[np.int32], kept: Mask, last: int = 0) -> tuple[NDArray[np.int32], int]:
    """Return numbers [H, W], with the kept ones [n] renumbered from `last` + 1 and others 0, and the last number."""
    return np.where(kept, np.cumsum(kept) + last, 0).astype(np.int32)[numbers], last + int(kept.sum())


def window(mask: Mask, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of the window around a mask with a margin; the mask must not be empty."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    top, left = max(rows[0] - margin, 0), max(columns[0] - margin, 0)
    return slice(top, rows[-1] + margin + 1), slice(left, columns[-1] + margin + 1)


def nearest_known(known: Mask) -> NDArray[np.int32]:
    """Return the index [H, W] of the nearest pixel of a mask, into `image[known]`; the mask must not be empty."""
    unknown = _bytes(~known)
    _, numbers = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    return np.asarray(numbers, np.int32) - 1  # OpenCV numbers the pixels of the mask from 1 on, row by row


def filled(labels: NDArray[np.int32], mask: Mask) -> NDArray[np.int32]:
    """Return labels in a mask, in which 0 is replaced by the nearest label, and 0 outside; a label must be given."""
    is_known = labels > 0
    return np.where(mask, labels[is_known].take(nearest_known(is_known)), 0)


def label_borders(labels: NDArray[np.int32], size: int) -> Mask:
    """Return the pixels with more than one label in the square of `size` pixels around them; labels are 0 to 65535."""
    square, image = np.ones((size, size), np.uint8), labels.astype(np.uint16)
    return np.asarray(cv2.dilate(image, square) != cv2.erode(image, square))


def subsampled(frame: RGBDFrame, stride: int) -> RGBDFrame:
    """Return a frame with the depth of every `stride`-th row and column, and mean colours; it has no labels."""
    depth, camera = np.ascontiguousarray(frame.depth[::stride, ::stride]), frame.intrinsics
    color = np.asarray(cv2.resize(frame.color, depth.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    scaled = {name: getattr(camera, name) / stride for name in ("fx", "fy", "cx", "cy")}
    return RGBDFrame(color, depth, None, dataclasses.replace(camera, width=None, height=None, **scaled))


def enlarged(labels: NDArray[np.int32], stride: int, shape: tuple[int, ...]) -> NDArray[np.int32]:
    """Return labels of a `subsampled` image in the shape [H, W] of the image: each fills `stride` x `stride` pixels."""
    return labels.repeat(stride, axis=0).repeat(stride, axis=1)[: shape[0], : shape[1]]


def watershed(color: NDArray[np.uint8], markers: NDArray[np.int32]) -> NDArray[np.int32]:
    """Flood pixels with the marker 0 from pixels with positive markers, up to the edges of a colour image.

    Args:
        color: [H, W, 3] uint8.
        markers: [H, W] int32.

    Returns:
        Markers [H, W] without 0. The line that OpenCV leaves between two regions goes to the higher number.
    """
    flooded = np.asarray(cv2.watershed(color, markers.copy()), np.int32)
    largest = cv2.dilate(np.maximum(flooded, 1).astype(np.float32), np.ones((3, 3), np.uint8))
    return np.where(flooded > 0, flooded, largest).astype(np.int32)
