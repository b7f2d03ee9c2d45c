"""Foreground of a plane: pixels that differ from it in height or colour, and edges of depth.

Edges are steps, where a surface ends in front of another, and folds, where two surfaces form a dent. Both are found by
extrapolation. In inverse depth a plane is linear, so the value two pixels after an edge is compared with that
extrapolated from two and six pixels before it, and the other way round. At a step the two differences have opposite
signs; at a fold both are positive, since both surfaces bend towards the camera.
"""

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from thor2_jax.segmentation.pixels import Mask, components, grow, nearest_known, open_round, pixel_mask, shrink
from thor2_jax.segmentation.planes import DepthImage, Plane

__all__ = ["UNIT", "Evidence", "find_foreground"]

HEIGHT = (0.006, 0.005)
"""Least height of a thing over its plane: the first in metres, plus the second times the squared depth in metres."""

FLAT = 0.05
"""Height, metres, below which smooth parts of the image may be the plane."""

COARSE = 2
"""Pixels of the image in a pixel of the coarse image of the plane's colour, in each direction."""

WINDOW = 25
"""Coarse pixels, in each direction, that the colour of the plane is averaged over."""

WIDE_WINDOW = 75
"""The same where the window holds too little of the plane: inside large things."""

WINDOWS_OF_OUTLIERS = (51, WINDOW)
"""Windows of whose mean colour the plane's pixels are, one after the other; large flat things fill the small one."""

OUTLIER = 30.0
"""Least difference of a coarse pixel that is no part of the plane, sum over the channels."""

LEAST_PLANE = 0.04
"""Least share of a window that the plane fills, or the plane's colour is unknown there."""

DIFFERENCE = 22.0
"""Least colour difference, in levels of 8 bits, between a thing and the plane."""

NOISE = 4.0
"""Least colour difference between a thing and the plane, as a multiple of the mean difference of the plane's pixels."""

DARKER, LIGHTER = 0.35, 0.5
"""Weights of differences in brightness: shadows and highlights are less of a sign than another hue."""

SHADE = 0.5
"""Largest change of hue of a pixel in the shade, as a share of its change of brightness."""

UNIT = 40
"""`Evidence.contrast` of a pixel with the least colour difference of a thing; 8 bits end at about six times as much."""

SMOOTH = 0.5
"""Largest change of contrast, in units, between neighbours in a smooth part of the plane, such as a soft shadow."""


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """Probabilities of each pixel by height and colour, and edges of depth; every field is an image [H, W].

    Attributes:
        heights: float32, metres over the support; 0 where depth is missing.
        high: pixels that are above a plane.
        contrast: uint8, colour difference to the support, `UNIT` where it is just noticeable; 0 far from the support.
        colored: pixels on the support, or without depth before it, whose colour is not the support's.
        shade: colored pixels on the support that are darker than it, but of its hue: deep shadows, and black things.
        region: pixels in the convex hull of the support.
        steps: steps of depth along rows and along columns.
        folds: folds of depth.
    """

    heights: NDArray[np.float32]
    high: Mask
    contrast: NDArray[np.uint8]
    colored: Mask
    shade: Mask
    region: Mask
    steps: tuple[Mask, Mask]
    folds: Mask


def find_foreground(color: NDArray[np.uint8], depth: DepthImage, planes: list[Plane]) -> Evidence:
    """Return the evidence for things on the planes, of which the first is the support.

    Args:
        color: [H, W, 3] uint8, sRGB, a little blurred.
        depth: the depth image.
        planes: at least one plane.
    """
    least = HEIGHT[1] * (depth.z * depth.z) + HEIGHT[0]
    heights = planes[0].heights(depth)
    on_support = (np.abs(heights) <= least) & depth.valid
    high = (heights > least) & depth.valid
    for plane in planes[1:]:
        others = plane.heights(depth)
        high = (high & (np.abs(others) > least)) | ((others > least) & ~on_support & depth.valid)
        on_support &= np.abs(heights) <= np.abs(others)
    contrast, darker, near, known = _color_contrast(color, on_support)
    region = shrink(planes[0].region(depth.z.shape), 3)
    known = near | (known & depth.valid & region)  # far from the plane, missing depth is rarely a thing on it
    contrast = contrast * known
    low = ((heights < FLAT) | ~depth.valid) & region & known
    gradient = np.asarray(cv2.morphologyEx(contrast, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)))
    smooth = pixel_mask(cv2.erode((low & (gradient < SMOOTH * UNIT)).view(np.uint8), np.ones((2, 2), np.uint8)))
    plain = _plain_parts(smooth, (contrast < UNIT) & on_support)
    beside = on_support | (~depth.valid & region)
    colored = open_round(beside & known & (contrast > UNIT) & ~plain)
    shade = open_round(colored & on_support & darker)
    return Evidence(heights, open_round(high), contrast, colored, shade, region, *_depth_edges(depth))


def _plain_parts(smooth: Mask, like_plane: Mask) -> Mask:
    """Return the smooth parts of the image of which most pixels have the plane's colour, grown by a pixel.

    Shadows and highlights are connected to the plane without an edge; things are not.
    """
    numbers, sizes = components(smooth)
    plain = np.bincount(numbers[like_plane], minlength=len(sizes)) > 0.5 * sizes
    plain[0] = False
    return grow(plain[numbers], 3)


def _color_contrast(color: NDArray[np.uint8], plane: Mask) -> tuple[NDArray[np.uint8], Mask, Mask, Mask]:
    """Compare each pixel with the pixels of the plane around it.

    Returns:
        `Evidence.contrast`, the pixels that are darker than the plane, but of its hue, and those with enough of the
        plane in their window, and in their wide window.
    """
    height, width = plane.shape
    around, near, window_share, share = _plane_color(color, plane)
    ones = np.ones((1, 3), np.float32)
    length = np.sqrt(_floats(cv2.transform(around * around, ones))) + np.float32(1e-3)
    direction = _floats(cv2.resize(around / length[..., None], (width, height), interpolation=cv2.INTER_LINEAR))
    reference = _floats(cv2.resize(length, (width, height), interpolation=cv2.INTER_LINEAR))
    # A shadow changes the length of a colour, not its direction. The products share memory: new memory costs time.
    product = cv2.multiply(color, direction, direction, dtype=cv2.CV_32F)
    along = _floats(cv2.transform(product, ones))
    across = _floats(cv2.transform(cv2.multiply(color, color, product, dtype=cv2.CV_32F), ones))
    across -= along * along
    brightness = along - reference
    darker = (brightness < 0) & (across < SHADE * SHADE * brightness * brightness)
    brightness *= np.where(brightness < 0, np.float32(DARKER), np.float32(LIGHTER))
    brightness *= brightness
    across += brightness
    difference = np.sqrt(np.maximum(across, 0, out=across), out=across)
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
    """Return, for coarse pixels [h, w]: the colour [h, w, 3] of the plane around, and the share of the plane.

    The mask has the pixels with enough of the plane in their window; elsewhere, the wide window is used. The first
    share is that of the window, the second that of the pixel itself.
    """
    height, width = plane.shape
    size = (-(-width // COARSE), -(-height // COARSE))
    masked = cv2.bitwise_and(color, color, mask=plane.view(np.uint8))
    total = _floats(cv2.resize(masked, size, interpolation=cv2.INTER_AREA))
    share = _floats(cv2.resize(plane.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    own = _floats(total / np.maximum(share, 0.05)[..., None])
    for window in WINDOWS_OF_OUTLIERS:  # leave out what has another colour than most of the window
        off = _floats(cv2.transform(cv2.absdiff(own, _window_mean(total, share, window)), np.ones((1, 3), np.float32)))
        full = share > 0.5
        typical = float(np.quantile(off[full], 0.5, method="higher")) if full.any() else 0.0
        kept = off < max(OUTLIER, 3 * typical)
        share, total = share * kept, total * kept[..., None]
    window_share = _floats(cv2.blur(share, (WINDOW, WINDOW)))
    mean = _window_mean(total, share, WINDOW)
    far = window_share < LEAST_PLANE  # inside large things
    mean[far] = _window_mean(total, share, WIDE_WINDOW)[far]
    window_share[far] = cv2.blur(share, (WIDE_WINDOW, WIDE_WINDOW))[far]
    return _floats(cv2.blur(mean, (3, 3))), ~far, window_share, share


def _window_mean(total: NDArray[np.float32], share: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    size = (window, window)
    return _floats(cv2.blur(total, size)) / (_floats(cv2.blur(share, size))[..., None] + np.float32(1e-4))


def _floats(image: object) -> NDArray[np.float32]:
    """Return an image of floats of OpenCV as an array."""
    return np.asarray(image, np.float32)


STEP = (0.006, 0.015)
"""Least step: the first in metres, plus the second times the squared depth in metres."""

NARROW = 0.4
"""Least share of a step between the two neighbours of a pixel."""

BEND = 0.4
"""Least change of slope at a fold."""

NEAR, FAR = 2, 6
"""Pixels between an edge and the values that are extrapolated."""


def _depth_edges(depth: DepthImage) -> tuple[tuple[Mask, Mask], Mask]:
    """Return the steps of a depth image along rows and along columns, and its folds, [H, W] each."""
    known = depth.valid
    if not known.any():
        none = np.zeros(known.shape, bool)
        return (none, none), none
    inverse = depth.inverse[known].take(nearest_known(known))
    inverse = np.asarray(cv2.medianBlur(inverse, 5))
    unknown = (~known).view(np.uint8)
    gap = np.asarray(cv2.dilate(cv2.distanceTransform(unknown, cv2.DIST_L2, 3), np.ones((3, 3), np.uint8)))
    # Metres are differences of inverse depth times the squared depth.
    least = STEP[0] * inverse * inverse + STEP[1]
    least_fold = 0.5 * least + (NEAR * BEND * depth.pixel_size) * inverse + gap
    # The value after a pixel minus its extrapolation, the same from the other side, and a difference.
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
