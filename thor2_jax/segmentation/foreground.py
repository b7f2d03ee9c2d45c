"""Foreground of a plane: pixels that differ from it in height or colour, and depth edges.

Edges are steps, where a surface ends in front of another one, and folds, where two surfaces form a dent. Both are found
by extrapolation. A plane is linear in inverse depth, so the value two pixels after an edge is compared with the value
extrapolated from two and six pixels before it, and vice versa. At a step, the two differences have opposite signs; at a
fold, both are positive, since both surfaces bend towards the camera.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from thor2_jax.segmentation.pixels import Mask, components, grow, nearest_known, open_round, pixel_mask, shrink
from thor2_jax.segmentation.planes import DepthImage, Plane

__all__ = ["UNIT", "Evidence"]

HEIGHT = (0.006, 0.005)
"""Smallest height of an object over its plane: the first in metres, plus the second times squared depth in metres."""

COARSE = 2
"""Number of pixels along each side of a pixel in the coarse image of the plane's colour."""

WINDOW = 25
"""Width, coarse pixels, of the window over which the colour of the plane is averaged."""

WIDE_WINDOW = 75
"""Width of the window where `WINDOW` contains too little of the plane, that is, inside large objects."""

WINDOWS_OF_OUTLIERS = (51, WINDOW)
"""Widths of windows whose mean colour the plane's pixels must have; large flat objects can fill the smaller window."""

OUTLIER = 30.0
"""Smallest colour difference between the plane and a coarse pixel outside it, summed over the channels."""

LEAST_PLANE = 0.04
"""Smallest fraction of a window that the plane must fill for its colour to be known there."""

DIFFERENCE = 22.0
"""Smallest colour difference, in levels of 8 bits, between an object and the plane."""

NOISE = 4.0
"""Smallest colour difference between object and plane, as a multiple of the mean difference of the plane's pixels."""

DARKER, LIGHTER = 0.35, 0.5
"""Weights of differences in brightness, which are smaller because of shadows and highlights."""

SHADE = 0.5
"""Largest change of hue of a pixel in the shade, as a fraction of its change of brightness."""

UNIT = 40
"""`Evidence.contrast` at the least colour difference of an object; the largest 8-bit value is about six times that."""

SMOOTH = 0.5
"""Largest change of contrast, in `UNIT`, between neighbours in a smooth part of the plane, such as a soft shadow."""


class Evidence:
    """Height and colour of each pixel relative to the planes, and depth edges; every attribute is an image [H, W].

    Attributes:
        heights: float32, metres over the support, which is the first plane; 0 where depth is missing.
        high: pixels above a plane.
        contrast: uint8, colour difference to the support, `UNIT` where it is just noticeable.
        colored: pixels on the support, or without depth in front of it, with another colour than the support.
        shade: colored pixels on the support that are darker, but have its hue: deep shadows, and black objects.
        region: pixels in the convex hull of the support.
        steps: depth steps along rows and along columns.
        folds: depth folds.
    """

    def __init__(self, color: NDArray[np.uint8], depth: DepthImage, planes: list[Plane]) -> None:
        """Compare an image with its planes.

        Args:
            color: [H, W, 3] uint8, sRGB, slightly blurred.
            depth: the depth image.
            planes: at least one plane.
        """
        least = HEIGHT[1] * (depth.z * depth.z) + HEIGHT[0]
        self.heights = planes[0].heights(depth)
        on_support = (np.abs(self.heights) <= least) & depth.valid
        high = self.heights > least  # not where depth is missing, since the height is 0 there
        for plane in planes[1:]:
            others = plane.heights(depth)
            high = (high & (np.abs(others) > least)) | ((others > least) & ~on_support)
            on_support &= np.abs(self.heights) <= np.abs(others)
        self.high = open_round(high)
        self.contrast, darker, near, known = _color_contrast(color, on_support)
        self.region = shrink(planes[0].region(depth.z.shape), 3)
        # Far from the plane, pixels without depth are rarely objects on it.
        known = near | (known & depth.valid & self.region)
        gradient = np.asarray(cv2.morphologyEx(self.contrast, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)))
        smooth = shrink(self.region & known & (gradient < SMOOTH * UNIT), 2)
        plain = _plain_parts(smooth, (self.contrast < UNIT) & on_support)
        beside = on_support | (~depth.valid & self.region)
        self.colored = open_round(beside & known & (self.contrast > UNIT) & ~plain)
        self.shade = open_round(self.colored & on_support & darker)
        self.steps, self.folds = _depth_edges(depth)


def _plain_parts(smooth: Mask, like_plane: Mask) -> Mask:
    """Return the smooth parts of the image in which most pixels have the plane's colour, grown by a pixel.

    Shadows and highlights are connected to the plane without an edge, unlike objects.
    """
    numbers, sizes = components(smooth)
    plain = np.bincount(numbers[smooth & like_plane], minlength=len(sizes)) > 0.5 * sizes
    return grow(plain[numbers], 3)


def _color_contrast(color: NDArray[np.uint8], plane: Mask) -> tuple[NDArray[np.uint8], Mask, Mask, Mask]:
    """Compare each pixel with the pixels of the plane around it.

    Returns:
        `Evidence.contrast`, the pixels that are darker than the plane but have its hue, and the pixels with enough of
        the plane in their window and in their wide window.
    """
    height, width = plane.shape
    around, near, window_share, share = _plane_color(color, plane)
    ones = np.ones((1, 3), np.float32)
    length = np.sqrt(_floats(cv2.transform(around * around, ones))) + np.float32(1e-3)
    direction = _floats(cv2.resize(around / length[..., None], (width, height), interpolation=cv2.INTER_LINEAR))
    reference = _floats(cv2.resize(length, (width, height), interpolation=cv2.INTER_LINEAR))
    # A shadow changes the length of a colour, not its direction.
    along = _floats(cv2.transform(cv2.multiply(color, direction, dtype=cv2.CV_32F), ones))
    across = _floats(cv2.transform(cv2.multiply(color, color, dtype=cv2.CV_32F), ones)) - along * along
    brightness = along - reference
    darker = (brightness < 0) & (across < SHADE * SHADE * brightness * brightness)
    weighted = brightness * np.where(brightness < 0, np.float32(DARKER), np.float32(LIGHTER))
    difference = np.sqrt(np.maximum(across + weighted * weighted, 0))
    size = (share.shape[1], share.shape[0])
    noise = cv2.resize(np.minimum(difference, 60) * plane, size, interpolation=cv2.INTER_AREA)
    noise = _floats(cv2.blur(noise * (share > 0), (WINDOW, WINDOW))) / (window_share + 1e-4)
    least = np.maximum(DIFFERENCE, NOISE * noise)
    scale = cv2.resize((UNIT / least).astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
    contrast = np.asarray(cv2.multiply(difference, scale, dtype=cv2.CV_8U), np.uint8)
    known = [
        pixel_mask(cv2.resize(mask.view(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST))
        for mask in (near, window_share > LEAST_PLANE)
    ]
    return contrast, darker, known[0], known[1]


def _plane_color(
    color: NDArray[np.uint8], plane: Mask
) -> tuple[NDArray[np.float32], Mask, NDArray[np.float32], NDArray[np.float32]]:
    """Return, for coarse pixels [h, w], the colour [h, w, 3] of the plane around, a mask, and fractions of the plane.

    The mask contains the pixels with enough of the plane in their window; elsewhere, the wide window is used. The first
    fraction is that of the plane in the window, the second that in the pixel itself.
    """
    height, width = plane.shape
    size = (-(-width // COARSE), -(-height // COARSE))
    masked = cv2.bitwise_and(color, color, mask=plane.view(np.uint8))
    total = _floats(cv2.resize(masked, size, interpolation=cv2.INTER_AREA))
    share = _floats(cv2.resize(plane.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    own = _floats(total / np.maximum(share, 0.05)[..., None])
    for window in WINDOWS_OF_OUTLIERS:  # leave out pixels whose colour differs from most of the window
        off = _floats(cv2.transform(cv2.absdiff(own, _window_mean(total, share, window)), np.ones((1, 3), np.float32)))
        full = share > 0.5
        typical = float(np.quantile(off[full], 0.5, method="higher")) if full.any() else 0.0
        kept = off < max(OUTLIER, 3 * typical)
        share, total = share * kept, total * kept[..., None]
    window_share = _floats(cv2.blur(share, (WINDOW, WINDOW)))
    mean = _window_mean(total, share, WINDOW)
    far = window_share < LEAST_PLANE  # inside large objects
    mean[far] = _window_mean(total, share, WIDE_WINDOW)[far]
    window_share[far] = cv2.blur(share, (WIDE_WINDOW, WIDE_WINDOW))[far]
    return _floats(cv2.blur(mean, (3, 3))), ~far, window_share, share


def _window_mean(total: NDArray[np.float32], share: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    size = (window, window)
    return _floats(cv2.blur(total, size)) / (_floats(cv2.blur(share, size))[..., None] + np.float32(1e-4))


def _floats(image: object) -> NDArray[np.float32]:
    """Return a floating-point image from OpenCV as an array."""
    return np.asarray(image, np.float32)


STEP = (0.006, 0.015)
"""Smallest step: the first in metres, plus the second times the squared depth in metres."""

NARROW = 0.4
"""Smallest fraction of a step that lies between the two neighbours of a pixel."""

BEND = 0.4
"""Smallest change of slope at a fold."""

NEAR, FAR = 2, 6
"""Number of pixels between an edge and the extrapolated values."""


def _depth_edges(depth: DepthImage) -> tuple[tuple[Mask, Mask], Mask]:
    """Return the steps of a depth image along rows and along columns, and its folds, each [H, W].

    The image has depth, since it has a plane.
    """
    known = depth.valid
    inverse = depth.inverse[known].take(nearest_known(known))
    inverse = np.asarray(cv2.medianBlur(inverse, 5))
    unknown = (~known).view(np.uint8)
    gap = np.asarray(cv2.dilate(cv2.distanceTransform(unknown, cv2.DIST_L2, 3), np.ones((3, 3), np.uint8)))
    # A difference of inverse depth times the squared depth is a difference in metres.
    least = STEP[0] * inverse * inverse + STEP[1]
    least_fold = 0.5 * least + (NEAR * BEND * depth.pixel_size) * inverse + gap
    # These are the value after a pixel minus its extrapolation, the same from the other side, and a difference.
    forward, slope = np.zeros(2 * FAR + 1, np.float32), 2 * NEAR / (FAR - NEAR)
    forward[[0, FAR - NEAR, FAR + NEAR]] = slope, -1 - slope, 1
    kernels, average = (forward, forward[::-1].copy(), np.array([-1, 0, 1], np.float32)), np.full(3, 1 / 3, np.float32)
    steps, folds = [], np.zeros(known.shape, bool)
    for along_rows in (True, False):  # averaged over three pixels across
        pairs = [(kernel, average) if along_rows else (average, kernel) for kernel in kernels]
        before, after, difference = (_floats(cv2.sepFilter2D(inverse, cv2.CV_32F, *pair)) for pair in pairs)
        smaller = np.minimum(np.abs(before), np.abs(after))
        opposite = (before > 0) != (after > 0)
        steps.append((smaller > least) & opposite & (np.abs(difference) > NARROW * least))
        folds |= np.minimum(before, after) > least_fold
    return (steps[0], steps[1]), folds
