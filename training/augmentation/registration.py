"""Augmentation of the registration of colour and depth: a blurred colour image, shifted against depth.

Some RGB-D cameras shift colour by up to ten pixels. Points near the outline then have colours of the background.
"""

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter

from training.augmentation.pixels import FRAME_PIXEL, pixel_width
from training.augmentation.settings import Range, Settings, limited
from training.rendering.camera import RenderedView

__all__ = ["Registration", "misregistered"]


@dataclasses.dataclass(frozen=True)
class Registration(Settings):
    """Ranges of the registration error; values are drawn once per view.

    Attributes:
        shifted: probability of a shift.
        shift: largest shift along rows and columns, in pixels of a real frame.
        blur: standard deviation of the blur of the colour image, in pixels of a real frame.
    """

    shifted: float = limited(0.5, 0, 1)
    shift: float = limited(10.0, 0, 100)
    blur: Range = limited((0.0, 3.0), 0, 50)


def misregistered(view: RenderedView, registration: Registration, rng: np.random.Generator) -> RenderedView:
    """Return the view with a blurred, shifted colour image; the background has one random colour."""
    seen = view.depth > 0
    if not seen.any():
        return view
    scale = FRAME_PIXEL / pixel_width(view)
    blur = rng.uniform(*registration.blur) * scale
    shift = np.zeros(2, int)
    if rng.random() < registration.shifted:
        shift = np.rint(rng.uniform(-registration.shift, registration.shift, 2) * scale).astype(int)
    background = rng.integers(0, 256, 3).astype(np.uint8)
    color = view.color
    if blur > 0.1:
        # Divided by the blurred mask, so that the object's border keeps its colour.
        weight = np.maximum(gaussian_filter(seen.astype(np.float32), blur), 1e-3)[..., None]
        color = gaussian_filter(color.astype(np.float32), (blur, blur, 0)) / weight
        color = color.clip(0, 255).astype(np.uint8)
    color = np.where(seen[..., None], color, background)
    margin = int(abs(shift).max())
    padded = np.pad(color - background, ((margin, margin), (margin, margin), (0, 0))) + background
    (row, column), (height, width) = margin + shift, seen.shape
    moved = padded[row : row + height, column : column + width]
    return dataclasses.replace(view, color=np.where(seen[..., None], moved, 0).astype(np.uint8))
