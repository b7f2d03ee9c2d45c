"""Flat views, and views with augmentations."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.frames.frames import Intrinsics
from training.augmentation.augmentations import Augmentations, augment
from training.rendering.camera import RenderedView


def flat_view(depth: NDArray[np.uint16], color: ArrayLike = (100, 100, 100), f: float = 1099.0) -> RenderedView:
    """Return a view of one colour with the principal point in its middle."""
    height, width = depth.shape
    colors = np.where(depth[..., None] > 0, np.array(color), 0).astype(np.uint8)
    return RenderedView(colors, depth, Intrinsics(f, f, (width - 1) / 2, (height - 1) / 2), np.eye(4), (200, 300))


def wall(z: int = 1500, size: int = 60, margin: int = 0) -> NDArray[np.uint16]:
    return np.pad(np.full((size, size), z, np.uint16), margin)


def augmented_view(view: RenderedView, seed: int, **settings: Any) -> RenderedView:
    return augment(view, Augmentations(**settings), np.random.default_rng(seed))
