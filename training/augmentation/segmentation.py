"""Augmentation of the mask: some pixels too small or too large, so that points are missing or of the background.

The background is a plane: the table, or a wall behind. Beyond the outline only background near the object in depth is
added: outlier removal in recognition drops the rest, a strip a few millimetres wide, as strays or as a small component.

Segmenters that remove the table plane also remove the base of an object, its lowest part.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, maximum_filter

from thor2_jax.frames.frames import Intrinsics, pixel_points
from thor2_jax.frames.outliers import PIECE_CELL
from training.augmentation.pixels import FRAME_PIXEL, Range, pixel_width, without
from training.rendering.view_sphere import TRAINING_CAMERA, RenderedView

__all__ = ["Base", "Segmentation", "resegmented", "without_base"]

MAX_BACKGROUND_GAP = 2 * PIECE_CELL
"""Largest distance of remaining background, metres: outlier removal treats adjacent cells as one component."""


@dataclasses.dataclass(frozen=True)
class Segmentation:
    """Ranges of the mask's error; values are drawn once per view.

    Attributes:
        pixels: by how many pixels of a real frame the mask is dilated; eroded if negative.
        tilt: angle between the background's normal and the optical axis, degrees.
        touching: probability that the background touches the visible object, as a table does.
        gap: distance between object and background otherwise, metres.
    """

    pixels: Range = (-8.0, 6.0)
    tilt: Range = (0.0, 70.0)
    touching: float = 0.7
    gap: Range = (0.0, 0.5)


def resegmented(view: RenderedView, segmentation: Segmentation, rng: np.random.Generator) -> RenderedView:
    """Return the view in a mask with a drawn error; an eroded mask keeps at least half of the pixels."""
    seen = view.depth > 0
    steps = round(rng.uniform(*segmentation.pixels) * FRAME_PIXEL / pixel_width(view))
    return _dilated(view, steps, segmentation, rng) if steps > 0 else _eroded(view, seen, -steps)


def _eroded(view: RenderedView, seen: NDArray[np.bool_], steps: int) -> RenderedView:
    mask, count = seen, int(seen.sum())
    for _ in range(steps):
        smaller = binary_erosion(mask)
        if 2 * int(smaller.sum()) < count:
            break
        mask = smaller
    return without(view, np.flatnonzero(seen & ~mask))


def _dilated(view: RenderedView, steps: int, segmentation: Segmentation, rng: np.random.Generator) -> RenderedView:
    view = _widened(view, steps)
    seen = view.depth > 0
    plane = _background(view, seen, segmentation, rng)
    added = binary_dilation(seen, iterations=steps) & ~seen & (plane > 0)
    added &= plane <= maximum_filter(view.depth, 2 * steps + 1) + 1000 * MAX_BACKGROUND_GAP
    color, depth = view.color.copy(), view.depth.copy()
    color[added] = rng.integers(0, 256, 3)
    depth[added] = plane[added]
    return dataclasses.replace(view, color=color, depth=depth)


def _widened(view: RenderedView, margin: int) -> RenderedView:
    """Return the view with a margin on all sides, within the image of the training camera."""
    camera, k = TRAINING_CAMERA, view.intrinsics
    sides = []
    for first, length, size in zip(view.corner, view.depth.shape, (camera.height, camera.width), strict=True):
        sides.append((min(margin, first), max(0, min(margin, size - first - length))))
    (top, _), (left, _) = sides
    color, depth = np.pad(view.color, (*sides, (0, 0))), np.pad(view.depth, sides)
    intrinsics = Intrinsics(k.fx, k.fy, k.cx + left, k.cy + top, k.depth_scale)
    return RenderedView(color, depth, intrinsics, view.pose, (view.corner[0] - top, view.corner[1] - left))


def _background(
    view: RenderedView, seen: NDArray[np.bool_], segmentation: Segmentation, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the depth [h, w] of a plane behind the object, millimetres; 0 where it is not visible."""
    tilt, azimuth = np.radians(rng.uniform(*segmentation.tilt)), rng.uniform(0, 2 * np.pi)
    gap = 0.0 if rng.random() < segmentation.touching else rng.uniform(*segmentation.gap)
    k, (height, width) = view.intrinsics, view.depth.shape
    # n . ray: negative where the plane faces the camera; n . point is this times the depth.
    facing = (
        np.sin(tilt) * np.cos(azimuth) * (np.arange(width) - k.cx) / k.fx
        + (np.sin(tilt) * np.sin(azimuth) * (np.arange(height) - k.cy) / k.fy)[:, None]
        - np.cos(tilt)
    )
    offset = (facing[seen] * view.depth[seen]).min() - 1000 * gap
    depth = offset / np.minimum(facing, -1e-3)
    return np.where(depth < 65535, np.rint(depth), 0).astype(np.uint16)


MAX_CUT = 0.4
"""Largest share of the visible pixels that is removed; a flat object would disappear."""


@dataclasses.dataclass(frozen=True)
class Base:
    """Ranges of the missing base; values are drawn once per view.

    Attributes:
        missing: probability that the base is missing.
        height: height of the missing part, metres.
        upright: probability that the object stands as its mesh does; otherwise it lies in a random orientation.
    """

    missing: float = 0.4
    height: Range = (0.003, 0.02)
    upright: float = 0.6


def without_base(view: RenderedView, base: Base, rng: np.random.Generator) -> RenderedView:
    """Return the view without the pixels near the table, or the view itself if that were most of it."""
    pixels = np.flatnonzero(view.depth)
    if rng.random() >= base.missing:
        return view
    up = np.array([0.0, 0.0, 1.0]) if rng.random() < base.upright else rng.standard_normal(3)
    up /= np.linalg.norm(up)
    depth = view.depth.take(pixels).astype(np.float32) / 1000
    points = pixel_points(pixels, depth, view.depth.shape[1], view.intrinsics)
    height = points @ (view.pose[:3, :3].T @ up).astype(np.float32)
    low = height - height.min() < rng.uniform(*base.height)
    return view if low.mean() > MAX_CUT else without(view, pixels[low])
