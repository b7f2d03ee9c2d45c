"""Segmentation of objects on a table, or another plane, without learned weights.

labels = segment_table(frame)          # [H, W] int32, 0 is background

Dominant planes are found and removed. Pixels above a plane, or on it with another colour, are grouped into pieces,
which are divided at depth steps, folds and colour edges.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.segmentation.foreground import Evidence
from thor2_jax.segmentation.pieces import find_pieces
from thor2_jax.segmentation.pixels import Mask, components, enlarged, grow, label_borders, subsampled, watershed, window
from thor2_jax.segmentation.planes import LARGEST_AREA, DepthImage, Plane, dominant_planes

__all__ = ["segment_table"]

WORKING_SIZE = 320
"""Larger side, pixels, of the images that are segmented; larger images are subsampled by a whole number."""

BAND = 3
"""Width, working pixels, of the square around a border in which the border is moved to a colour edge."""

MARGIN = 4
"""Margin around all objects, working pixels, in which their borders are moved; the rest of the image is background."""

LEAST_PIXELS = 20
LEAST_AREA = 2e-4
"""Smallest area of an object, square metres."""

LEAST_SUPPORT = 0.3
"""Smallest fraction of the pixels of an object that lie in the hull of a plane."""

HOLE = 0.3
"""Largest hole in an object that is filled, as a fraction of the object, such as the handle of scissors."""

LEAST_INNER = 0.9
"""Smallest fraction of an object inside its rim of half a working pixel; thinner objects keep their rim."""


def segment_table(frame: RGBDFrame) -> NDArray[np.int32]:
    """Segment the objects on the dominant planes of a frame; its labels are ignored.

    Args:
        frame: colour, depth and intrinsics.

    Returns:
        Labels [H, W]: 0 is background, and the objects are numbered from 1 without a gap in the order of their first
        pixels. Without a dominant plane, everything is background. Equal frames get equal labels.
    """
    stride = max(1, round(max(frame.depth.shape) / WORKING_SIZE))
    small = subsampled(frame, stride)
    # Lens distortion is ignored, since the planes' second-order terms absorb it.
    depth = DepthImage(small.depth_m, small.intrinsics)
    planes = dominant_planes(depth)
    if not planes:
        return np.zeros(frame.depth.shape, np.int32)
    evidence = Evidence(small.color, depth, planes)
    labels = _cleaned(find_pieces(small.color, depth, evidence), depth, planes)
    return _refined(labels, frame.color, stride) if stride > 1 else labels


def _refined(labels: NDArray[np.int32], color: NDArray[np.uint8], stride: int) -> NDArray[np.int32]:
    """Return labels in the size of the colour image, with borders along its edges."""
    refined = np.zeros(color.shape[:2], np.int32)
    if not labels.any():
        return refined
    around = window(labels > 0, MARGIN)
    labels = labels[around]
    here = tuple(slice(stride * part.start, stride * part.stop) for part in around)
    markers = np.where(label_borders(labels, BAND), 0, labels + 1)
    markers = enlarged(markers, stride, refined[here].shape)
    blurred = np.asarray(cv2.GaussianBlur(np.ascontiguousarray(color[here]), (3, 3), 0), np.uint8)
    refined[here] = _trimmed(watershed(blurred, markers) - 1, 2 * (stride // 2) + 1)
    return refined


def _trimmed(labels: NDArray[np.int32], size: int) -> NDArray[np.int32]:
    """Return labels without the rims of objects, where depth belongs to one surface and colour to another.

    A pixel belongs to the rim if the square of `size` pixels around it contains another label.
    """
    is_rim = label_borders(labels, size)
    sizes = np.bincount(labels.ravel())
    is_thick = np.bincount(labels[~is_rim], minlength=len(sizes)) >= LEAST_INNER * sizes
    return np.where(is_rim & is_thick[labels], 0, labels)


def _cleaned(labels: NDArray[np.int32], depth: DepthImage, planes: list[Plane]) -> NDArray[np.int32]:
    """Return the objects among the pieces, without holes and numbered from 1."""
    region = grow(np.any([plane.region(labels.shape) for plane in planes], axis=0), 5)
    cleaned, count = np.zeros_like(labels), 0
    for label, place in enumerate(ndimage.find_objects(labels), start=1):
        if place is None:
            continue
        numbers, sizes = components(labels[place] == label, connectivity=8)
        mask = numbers == sizes.argmax()
        if _is_thing(mask, depth.z[place], depth, region[place]):
            count += 1
            cleaned[place][_without_holes(mask) & np.isin(labels[place], (0, label))] = count
    return cleaned


def _is_thing(mask: Mask, z: NDArray[np.float32], depth: DepthImage, region: Mask) -> bool:
    size = int(mask.sum())
    if size < LEAST_PIXELS or region[mask].mean() < LEAST_SUPPORT:
        return False
    z = z[mask & (z > 0)]
    distance = float(np.quantile(z, 0.5, method="higher")) if len(z) else 1.0
    return LEAST_AREA <= size * (distance * depth.pixel_size) ** 2 <= LARGEST_AREA


def _without_holes(mask: Mask) -> Mask:
    numbers, sizes = components(np.pad(~mask, 1, constant_values=True))
    sizes[1] = 0  # the first pixel is outside
    filled = (sizes > 0) & (sizes < HOLE * mask.sum())
    return mask | filled[numbers[1:-1, 1:-1]]
