"""The camera of the training views and the record of a rendered view."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.frames import Intrinsics

__all__ = ["TRAINING_CAMERA", "Camera", "RenderedView"]


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centres have integer coordinates.

    Attributes:
        width: image width, pixels.
        height: image height, pixels.
        intrinsics: focal lengths and principal point, pixels.
    """

    width: int
    height: int
    intrinsics: Intrinsics

    @classmethod
    def from_field_of_view(cls, width: int, height: int, degrees: float) -> "Camera":
        """Return a camera with square pixels, a central principal point and a horizontal field of view in degrees."""
        f = width / 2 / math.tan(math.radians(degrees) / 2)
        return cls(width, height, Intrinsics(f, f, (width - 1) / 2, (height - 1) / 2))


TRAINING_CAMERA = Camera.from_field_of_view(800, 600, 40.0)
"""The camera of the training views (paper, section "Training")."""


@dataclasses.dataclass(frozen=True)
class RenderedView:
    """A rendered view, cropped to the part of the camera's image that the object can cover; the rest is empty.

    Attributes:
        color: [h, w, 3] uint8 sRGB, 0 where nothing is visible.
        depth: [h, w] uint16, depth along the camera's z axis, millimetres, rounded; 0 where nothing is visible.
        intrinsics: intrinsics of the cropped image.
        pose: [4, 4] float64, camera to object frame.
        corner: row and column of the cropped image's first pixel in the camera's image.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    intrinsics: Intrinsics
    pose: NDArray[np.float64]
    corner: tuple[int, int]
