"""RGB-D views of meshes by ray casting (embree): unlit surface colours, depth in millimetres.

    caster = RayCaster([mesh])                                    # once a mesh
    view = render_view(caster, camera_pose(0.0, 1.2, mesh.centre))   # view.color, view.depth, view.intrinsics

Scans carry the light of the studio baked into their textures, so no light is added.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from thor2_jax.recognition.frames import Intrinsics
from training.objects.mesh import TexturedMesh
from training.rendering.camera import TRAINING_CAMERA, Camera, RenderedView

__all__ = ["Hits", "RayCaster", "pixel_rays", "render_view"]


@dataclasses.dataclass(frozen=True)
class Hits:
    """Where rays first meet a surface.

    Attributes:
        distance: [n] float32, in lengths of the ray's direction; inf where the ray meets nothing.
        mesh: [n] int32, index of the mesh that is hit; -1 where none is.
        color: [n, 3] uint8; 0 where nothing is hit.
    """

    distance: NDArray[np.float32]
    mesh: NDArray[np.int32]
    color: NDArray[np.uint8]


class RayCaster:
    """Meshes in one frame, indexed for ray casting. Cannot be pickled: build one in each process."""

    def __init__(self, meshes: Sequence[TexturedMesh]) -> None:
        """Builds the index, about 20 ms for a mesh of 16,000 faces.

        Raises:
            ValueError: no meshes.
        """
        if not meshes:
            raise ValueError("meshes is empty; at least one is needed")
        self.meshes = tuple(meshes)
        self._scene = EmbreeScene()
        for mesh in self.meshes:
            TriangleMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces)
        self.vertices = np.concatenate([mesh.vertices[np.unique(mesh.faces)] for mesh in self.meshes])
        """[n, 3] float64: vertices of all faces of all meshes."""

    def cast(self, origin: NDArray[np.floating], directions: NDArray[np.floating]) -> Hits:
        """First hit of each ray.

        Args:
            origin: [3], common to all rays.
            directions: [n, 3], of any length.
        """
        directions = np.ascontiguousarray(directions, np.float32)
        origins = np.empty_like(directions)
        origins[:] = origin
        found = self._scene.run(origins, directions, output=True)
        hit = np.flatnonzero(found["primID"] >= 0)
        distance = np.full(len(directions), np.inf, np.float32)
        distance[hit] = found["tfar"][hit]
        which = np.full(len(directions), -1, np.int32)
        which[hit] = found["geomID"][hit]
        color = np.zeros((len(directions), 3), np.uint8)
        barycentric = np.stack([found["u"], found["v"]], axis=1)
        for index, mesh in enumerate(self.meshes):
            here = hit[which[hit] == index]
            if len(here):
                color[here] = mesh.colors_at(found["primID"][here], barycentric[here])
        return Hits(distance, which, color)


def pixel_rays(intrinsics: Intrinsics, height: int, width: int) -> NDArray[np.float64]:
    """Rays through the pixels [height * width, 3] float64 in the camera frame, z = 1: a ray's length is a depth."""
    rays = np.ones((height, width, 3))
    rays[..., 0] = (np.arange(width) - intrinsics.cx) / intrinsics.fx
    rays[..., 1] = ((np.arange(height) - intrinsics.cy) / intrinsics.fy)[:, None]
    return rays.reshape(-1, 3)


def _pixel_box(vertices: NDArray[np.float64], pose: NDArray[np.float64], camera: Camera) -> tuple[int, int, int, int]:
    """First and one-past-last row and column that the vertices can fill; never empty."""
    in_camera = (vertices - pose[:3, 3]) @ pose[:3, :3]
    if in_camera[:, 2].min() <= 0:
        return 0, camera.height, 0, camera.width
    k = camera.intrinsics
    box = []
    for axis, (f, c, size) in enumerate([(k.fx, k.cx, camera.width), (k.fy, k.cy, camera.height)]):
        pixels = in_camera[:, axis] / in_camera[:, 2] * f + c
        low = int(np.clip(np.floor(pixels.min()), 0, size - 1))
        box.append((low, int(np.clip(np.ceil(pixels.max()) + 1, low + 1, size))))
    return *box[1], *box[0]


def render_view(caster: RayCaster, pose: NDArray[np.float64], camera: Camera = TRAINING_CAMERA) -> RenderedView:
    """Colours and depth as seen from a pose.

    Args:
        caster: the object.
        pose: [4, 4] camera to object frame, as from `camera_pose`.
        camera: size and intrinsics of the whole image.

    Returns:
        The part of the image where the object can be: a twentieth of the whole for a mug, and as much faster.
    """
    top, bottom, left, right = _pixel_box(caster.vertices, pose, camera)
    k = camera.intrinsics
    intrinsics = Intrinsics(k.fx, k.fy, k.cx - left, k.cy - top)
    height, width = bottom - top, right - left
    hits = caster.cast(pose[:3, 3], pixel_rays(intrinsics, height, width) @ pose[:3, :3].T)
    distance = np.where(hits.mesh >= 0, hits.distance, 0)
    depth = np.rint(distance.astype(np.float64) * 1000).astype(np.uint16).reshape(height, width)
    return RenderedView(hits.color.reshape(height, width, 3), depth, intrinsics, pose, (top, left))
