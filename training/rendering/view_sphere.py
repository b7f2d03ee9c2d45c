"""Cameras of training views: intrinsics, rendered views, and poses on the view sphere (paper, section "Training").

    poses = [camera_pose(azimuth, polar, mesh.centre) for azimuth, polar in view_angles()]   # 2,664 poses

The object's frame is that of the scan, with z up. The polar angle is 0 from above, pi/2 from the side, pi from below.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics, RGBDFrame

__all__ = ["Camera", "DISTANCE", "RenderedView", "TRAINING_CAMERA", "camera_pose", "random_angles", "view_angles"]


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

    @property
    def frame(self) -> RGBDFrame:
        """The view as a frame in which the visible pixels are the instance 1."""
        return RGBDFrame(self.color, self.depth, (self.depth > 0).astype(np.uint8), self.intrinsics)


DISTANCE = 1.5
"""Distance between the camera and the centre of the object's bounding box, metres."""

FROM_ABOVE = 0.7
"""Share of random views from above or from slightly below the middle of the object."""

MAX_VIEWS = 10**6
"""Largest number of views of an object: 375 times the paper's."""


def _steps(name: str, step: float, turn: float) -> int:
    count = turn / step if math.isfinite(step) and step > 1e-100 else 0.0  # of smaller ones, the quotient may overflow
    if round(count) < 1 or abs(count - round(count)) > 1e-6:
        raise InputError(f"{name} is {step!r}; expected degrees that divide {turn:g} evenly")
    return round(count)


def view_angles(azimuth_step: float = 5.0, polar_step: float = 5.0) -> NDArray[np.float64]:
    """Return the angles of all views: azimuth in [0, 2 pi) and polar angle in [0, pi], with both poles.

    Args:
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.

    Returns:
        [n, 2] float64, azimuth and polar angle in radians, azimuth varying fastest; 72 x 37 rows by default.

    Raises:
        InputError: A step is not positive, does not divide its range or gives more than `MAX_VIEWS` views.
    """
    n, n_polar = _steps("azimuth_step", azimuth_step, 360), _steps("polar_step", polar_step, 180) + 1
    if n * n_polar > MAX_VIEWS:
        raise InputError(
            f"azimuth_step {azimuth_step:g} and polar_step {polar_step:g} give {n * n_polar:.0e} views per object; "
            f"expected at most {MAX_VIEWS:.0e}; choose larger steps"
        )
    azimuths = np.arange(n) * (2 * np.pi / n)
    polars = np.linspace(0, np.pi, n_polar)
    return np.stack([np.tile(azimuths, len(polars)), np.repeat(polars, n)], axis=1)


def random_angles(rng: np.random.Generator) -> tuple[float, float]:
    """Return the azimuth and polar angle of a random view, in radians; most look down on the object, as on a table."""
    low, high = (-0.15, 0.97) if rng.random() < FROM_ABOVE else (-1.0, 1.0)
    return rng.uniform(0, 2 * np.pi), float(np.arccos(rng.uniform(low, high)))


def camera_pose(
    azimuth: float, polar: float, centre: NDArray[np.float64], distance: float = DISTANCE
) -> NDArray[np.float64]:
    """Return the pose of a camera on the view sphere that looks at `centre`.

    The image's down direction is that of increasing polar angle: z is up in the image. At the poles it follows the
    meridian of `azimuth`, so that the image rotates with the azimuth.

    Args:
        azimuth: radians, from the x axis towards the y axis.
        polar: radians, from the z axis.
        centre: [3], metres.
        distance: from the camera to `centre`, metres.

    Returns:
        [4, 4] float64, camera to object frame; columns are the camera's x (right), y (down), z (forward) and position.
    """
    ca, sa, cp, sp = math.cos(azimuth), math.sin(azimuth), math.cos(polar), math.sin(polar)
    outward = np.array([sp * ca, sp * sa, cp])
    pose = np.eye(4)
    pose[:3, 0] = -sa, ca, 0.0
    pose[:3, 1] = cp * ca, cp * sa, -sp
    pose[:3, 2] = -outward
    pose[:3, 3] = centre + distance * outward
    return pose
