"""The depth camera of rendered views: intrinsics, poses on the view sphere, ray casting, and the noise of depth.

    poses = [camera_pose(azimuth, polar, mesh.centre) for azimuth, polar in view_angles()]   # 2,664 poses
    caster = RayCaster([mesh])                                    # once per mesh
    view = caster.render(poses[0])                                # view.color, view.depth, view.intrinsics

The object's frame is the frame of the scan, with z up. The polar angle is 0 from above, pi/2 from the side, pi from
below (paper, section "Training"). No light is added, since the textures of scans already contain the studio's light.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thor2_jax import InputError, Intrinsics, RGBDFrame
from training.objects.mesh import TexturedMesh

__all__ = [
    "Camera",
    "DISTANCE",
    "RayCaster",
    "RenderedView",
    "TRAINING_CAMERA",
    "axial_deviation",
    "camera_pose",
    "depth_edges",
    "pixel_rays",
    "random_angles",
    "view_angles",
]


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

    @property
    def record(self) -> dict[str, Any]:
        """The camera and the distance of training views, in JSON types.

        Fields of the intrinsics without a value are left out, as in version 0.1.0.
        """
        intrinsics = {name: value for name, value in dataclasses.asdict(self.intrinsics).items() if value}
        return {"width": self.width, "height": self.height, "intrinsics": intrinsics, "distance": DISTANCE}

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
        corner: row and column, in the camera's image, of the first pixel of the cropped image.
    """

    color: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    intrinsics: Intrinsics
    pose: NDArray[np.float64]
    corner: tuple[int, int]

    @property
    def frame(self) -> RGBDFrame:
        """The view as a frame in which the visible pixels have the label 1."""
        return RGBDFrame(self.color, self.depth, (self.depth > 0).astype(np.uint8), self.intrinsics)

    @property
    def pixel_width(self) -> float:
        """Width of a pixel on the object, metres, at the mean depth; at least one pixel must have depth."""
        return float(self.depth.sum() / np.count_nonzero(self.depth)) / 1000 / self.intrinsics.fx

    def without(self, pixels: NDArray[np.intp]) -> "RenderedView":
        """Return the view without `pixels`, flat indices [n]."""
        color, depth = self.color.copy(), self.depth.copy()
        color.reshape(-1, 3)[pixels] = 0
        depth.reshape(-1)[pixels] = 0
        return dataclasses.replace(self, color=color, depth=depth)


DISTANCE = 1.5
"""Distance between the camera and the centre of the object's bounding box, metres."""

FROM_ABOVE = 0.7
"""Fraction of random views that look from above or from slightly below the middle of the object."""

MAX_VIEWS = 10**6
"""Largest number of views of an object: 375 times as many as in the paper."""


def _steps(name: str, step: float, turn: float) -> int:
    count = turn / step if math.isfinite(step) and step > 1e-100 else 0.0  # the quotient of smaller steps may overflow
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
        InputError: a step is not positive, does not divide its range or gives more than `MAX_VIEWS` views.
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
    """Return the azimuth and polar angle of a random view, in radians; most views look down, as at a table."""
    low, high = (-0.15, 0.97) if rng.random() < FROM_ABOVE else (-1.0, 1.0)
    return rng.uniform(0, 2 * np.pi), float(np.arccos(rng.uniform(low, high)))


def camera_pose(
    azimuth: float, polar: float, centre: NDArray[np.float64], distance: float = DISTANCE
) -> NDArray[np.float64]:
    """Return the pose of a camera on the view sphere that looks at `centre`.

    The image's down direction is the direction of increasing polar angle, so z is up in the image. At the poles, it
    follows the meridian of `azimuth`, so that the image rotates with the azimuth.

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


def pixel_rays(intrinsics: Intrinsics, height: int, width: int, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays through the pixels [height * width, 3] float64, object frame, of a camera with this pose [4, 4].

    Their component along the optical axis is 1, so that hit distances are depths.
    """
    x, y, z = pose[:3, :3].T
    columns = ((np.arange(width) - intrinsics.cx) / intrinsics.fx)[:, None] * x
    rows = ((np.arange(height) - intrinsics.cy) / intrinsics.fy)[:, None] * y
    return ((rows + z)[:, None] + columns).reshape(-1, 3)


def _pixel_box(vertices: NDArray[np.float64], pose: NDArray[np.float64], camera: Camera) -> tuple[int, int, int, int]:
    """Return the range of rows and columns that the vertices can cover (first, end, first, end); never empty."""
    in_camera = (vertices - pose[:3, 3]) @ pose[:3, :3]
    if in_camera[:, 2].min() <= 0:
        return 0, camera.height, 0, camera.width
    k, size = camera.intrinsics, np.array([camera.width, camera.height])
    pixels = in_camera[:, :2] / in_camera[:, 2:] * [k.fx, k.fy] + [k.cx, k.cy]
    low = np.clip(np.floor(pixels.min(axis=0)), 0, size - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, low + 1, size).astype(int)
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    return top, bottom, left, right


class Hits(NamedTuple):
    """First intersections of rays with surfaces.

    Attributes:
        distance: [n] float32, in units of the direction's length; 0 without a hit.
        mesh: [n] int32, index of the hit mesh; -1 without a hit.
        color: [n, 3] uint8; 0 without a hit.
    """

    distance: NDArray[np.float32]
    mesh: NDArray[np.int32]
    color: NDArray[np.uint8]


class RayCaster:
    """Meshes in one coordinate frame, indexed for ray casting (embree).

    It cannot be pickled: create one in each process.
    """

    def __init__(self, meshes: Sequence[TexturedMesh]) -> None:
        """Build the ray-casting index of at least one mesh; this takes about 20 ms for a mesh of 16,000 faces."""
        # Imported here, since there is no embree for ARM on Linux, where nothing is rendered.
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.meshes = tuple(meshes)
        self._scene = EmbreeScene()
        for mesh in self.meshes:
            TriangleMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces)
        self.vertices = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in self.meshes])
        """[n, 3] float64: vertices of all faces of all meshes."""

    def cast(self, origin: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """Return the first hit of each ray.

        Args:
            origin: [3], common to all rays.
            directions: [n, 3], of any length.
        """
        directions = np.ascontiguousarray(directions, np.float32)
        result = self._scene.run(np.full_like(directions, origin), directions, output=True)
        color = np.zeros((len(directions), 3), np.uint8)
        for index, mesh in enumerate(self.meshes):
            here = np.flatnonzero(result["geomID"] == index)
            barycentric = np.stack([result["u"].take(here), result["v"].take(here)]).T
            color[here] = mesh.colors_at(result["primID"].take(here), barycentric)
        distance = np.where(result["geomID"] >= 0, result["tfar"], np.float32(0))
        return Hits(distance, result["geomID"], color)

    def render(self, pose: NDArray[np.float64], camera: Camera = TRAINING_CAMERA) -> RenderedView:
        """Render colours and depth from a pose.

        Args:
            pose: [4, 4] camera to object frame, as from `camera_pose`.
            camera: size and intrinsics of the whole image.

        Returns:
            The part of the image that the object can cover, which saves time: for a mug, a twentieth of the image.
        """
        top, bottom, left, right = _pixel_box(self.vertices, pose, camera)
        k = camera.intrinsics
        intrinsics = Intrinsics(k.fx, k.fy, k.cx - left, k.cy - top)
        height, width = bottom - top, right - left
        hits = self.cast(pose[:3, 3], pixel_rays(intrinsics, height, width, pose))
        depth = np.rint(hits.distance.astype(np.float64) * 1000).astype(np.uint16).reshape(height, width)
        return RenderedView(hits.color.reshape(height, width, 3), depth, intrinsics, pose, (top, left))


def axial_deviation(z: Any) -> Any:
    """Return the axial standard deviation of depth at distances z, both in metres.

    It is 1.2 mm + 1.9 mm (z / m - 0.4)^2 (Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D
    reconstruction and tracking", 3DIMPVT 2012).
    """
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


def depth_edges(depth: NDArray[np.floating], step: float) -> NDArray[np.bool_]:
    """Return the pixels whose depth differs from a neighbour's by more than `step`; missing depth counts as 0."""
    edge = np.zeros(depth.shape, bool)
    for here, beside in ((edge, depth), (edge.T, depth.T)):
        far = np.abs(np.diff(beside, axis=0)) > step
        here[1:] |= far
        here[:-1] |= far
    return edge
