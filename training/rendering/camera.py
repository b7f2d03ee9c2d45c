"""The camera of the training views and the record of a rendered view."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognition.frames import Intrinsics

__all__ = ["TRAINING_CAMERA", "Camera", "RenderedView"]


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centres have integer coordinates.

    Attributes:
        width: pixels.
        height: pixels.
        intrinsics: in pixels.
    """

    width: int
    height: int
    intrinsics: Intrinsics

    @classmethod
    def from_field_of_view(cls, width: int, height: int, degrees: float) -> "Camera":
        """A camera with square pixels, the axis through the image's centre, a horizontal field of view in degrees."""
        f = width / 2 / math.tan(math.radians(degrees) / 2)
        return cls(width, height, Intrinsics(f, f, (width - 1) / 2, (height - 1) / 2))


TRAINING_CAMERA = Camera.from_field_of_view(800, 600, 40.0)
"""The camera of the training views (paper, section "Training")."""


@dataclasses.dataclass(frozen=True)
class RenderedView:
    """The part of a camera's image that an object can fill; the rest of the image is empty.

    Attributes:
        color: [h, w, 3] uint8 sRGB, 0 where nothing is seen.
        depth: [h, w] uint16, millimetres along the camera's z, rounded; 0 where nothing is seen.
        intrinsics: of this part as an image of its own.
        pose: [4, 4] float64, camera to object frame.
        corner: row and column of this part's first pixel in the camera's image.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    intrinsics: Intrinsics
    pose: NDArray[np.float64]
    corner: tuple[int, int]

    def full_image(self, camera: Camera = TRAINING_CAMERA) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """The whole image of the camera that rendered the view: color [H, W, 3] uint8 and depth [H, W] uint16."""
        rows, columns = (slice(c, c + n) for c, n in zip(self.corner, self.depth.shape, strict=True))
        color = np.zeros((camera.height, camera.width, 3), np.uint8)
        depth = np.zeros((camera.height, camera.width), np.uint16)
        color[rows, columns], depth[rows, columns] = self.color, self.depth
        return color, depth
