"""Render RGB-D views of meshes by ray casting (embree): unlit surface colours, depth in millimetres.

    caster = RayCaster([mesh])                                    # once per mesh
    view = render_view(caster, camera_pose(0.0, 1.2, mesh.centre))   # view.color, view.depth, view.intrinsics

The textures of scans contain the light of the studio, so no light is added.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from thor2_jax.frames.frames import Intrinsics
from training.objects.mesh import TexturedMesh
from training.rendering.view_sphere import TRAINING_CAMERA, Camera, RenderedView

__all__ = ["Hits", "RayCaster", "pixel_rays", "render_view"]


@dataclasses.dataclass(frozen=True)
class Hits:
    """First intersections of rays with surfaces.

    Attributes:
        distance: [n] float32, in units of the direction's length; inf without a hit.
        mesh: [n] int32, index of the mesh that is hit; -1 without a hit.
        color: [n, 3] uint8; 0 without a hit.
    """

    distance: NDArray[np.float32]
    mesh: NDArray[np.int32]
    color: NDArray[np.uint8]


class RayCaster:
    """Meshes in one coordinate frame, indexed for ray casting. It cannot be pickled: create one in each process."""

    def __init__(self, meshes: Sequence[TexturedMesh]) -> None:
        """Build the index of at least one mesh, which takes about 20 ms for a mesh of 16,000 faces."""
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
        origins = np.full_like(directions, origin)
        result = self._scene.run(origins, directions, output=True)
        hit = np.flatnonzero(result["primID"] >= 0)
        distance = np.full(len(directions), np.inf, np.float32)
        distance[hit] = result["tfar"][hit]
        mesh_index = np.full(len(directions), -1, np.int32)
        mesh_index[hit] = result["geomID"][hit]
        color = np.zeros((len(directions), 3), np.uint8)
        for index, mesh in enumerate(self.meshes):
            here = hit[mesh_index[hit] == index]
            if len(here):
                barycentric = np.stack([result["u"].take(here), result["v"].take(here)]).T
                color[here] = mesh.colors_at(result["primID"].take(here), barycentric)
        return Hits(distance, mesh_index, color)


def pixel_rays(intrinsics: Intrinsics, height: int, width: int, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rays through the pixels [height * width, 3] float64, object frame, of a camera with this pose [4, 4].

    Along the optical axis their length is 1, so that hit distances are depths.
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
    k = camera.intrinsics
    box = []
    for axis, (f, c, size) in enumerate([(k.fx, k.cx, camera.width), (k.fy, k.cy, camera.height)]):
        pixels = in_camera[:, axis] / in_camera[:, 2] * f + c
        low = int(np.clip(np.floor(pixels.min()), 0, size - 1))
        box.append((low, int(np.clip(np.ceil(pixels.max()) + 1, low + 1, size))))
    return *box[1], *box[0]


def render_view(caster: RayCaster, pose: NDArray[np.float64], camera: Camera = TRAINING_CAMERA) -> RenderedView:
    """Render colours and depth from a pose.

    Args:
        caster: index of the object.
        pose: [4, 4] camera to object frame, as from `camera_pose`.
        camera: size and intrinsics of the whole image.

    Returns:
        The part of the image that the object can cover: for a mug a twentieth of the image, and as much faster.
    """
    top, bottom, left, right = _pixel_box(caster.vertices, pose, camera)
    k = camera.intrinsics
    intrinsics = Intrinsics(k.fx, k.fy, k.cx - left, k.cy - top)
    height, width = bottom - top, right - left
    hits = caster.cast(pose[:3, 3], pixel_rays(intrinsics, height, width, pose))
    distance = np.where(hits.mesh >= 0, hits.distance, 0)
    depth = np.rint(distance.astype(np.float64) * 1000).astype(np.uint16).reshape(height, width)
    return RenderedView(hits.color.reshape(height, width, 3), depth, intrinsics, pose, (top, left))
