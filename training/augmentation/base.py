"""Augmentation of the mask's base: segmenters that remove the table plane also remove the object's lowest part."""

import dataclasses

import numpy as np

from thor2_jax.frames.frames import backproject
from training.augmentation.pixels import without
from training.augmentation.settings import Range, Settings, limited
from training.rendering.camera import RenderedView

__all__ = ["Base", "without_base"]

MAX_CUT = 0.4
"""Largest share of the visible pixels that is removed; a flat object would disappear."""


@dataclasses.dataclass(frozen=True)
class Base(Settings):
    """Ranges of the missing base; values are drawn once per view.

    Attributes:
        missing: probability that the base is missing.
        height: height of the missing part, metres.
        upright: probability that the object stands as its mesh does; otherwise it lies in a random orientation.
    """

    missing: float = limited(0.3, 0, 1)
    height: Range = limited((0.003, 0.015), 0, 0.1)
    upright: float = limited(0.6, 0, 1)


def without_base(view: RenderedView, base: Base, rng: np.random.Generator) -> RenderedView:
    """Return the view without the pixels near the table, or the view itself if that were most of it."""
    pixels = np.flatnonzero(view.depth)
    if len(pixels) == 0 or rng.random() >= base.missing:
        return view
    up = np.array([0.0, 0.0, 1.0]) if rng.random() < base.upright else rng.standard_normal(3)
    up /= np.linalg.norm(up)
    points = backproject(view.depth.astype(np.float32) / 1000, view.intrinsics).reshape(-1, 3)[pixels]
    height = points @ (view.pose[:3, :3].T @ up).astype(np.float32)
    low = height - height.min() < rng.uniform(*base.height)
    return view if low.mean() > MAX_CUT else without(view, pixels[low])
