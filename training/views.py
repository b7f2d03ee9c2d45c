"""Training clouds: one coloured point cloud a view of a mesh (paper, section "Training").

Example:
    for view in iterate_views({"mug": load_mesh("mug.glb")}, view_angles(), workers=2):
        view.name, view.azimuth, view.polar, view.xyz, view.rgb
"""

import collections
import dataclasses
import multiprocessing
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.frames import backproject
from thor2_jax.recognizer import VOXEL
from thor2_jax.voxel_grid import voxel_downsample
from training.meshes import TexturedMesh
from training.rendering import TRAINING_CAMERA, Camera, RayCaster, RenderedView, render_view
from training.view_sphere import camera_pose

__all__ = ["MIN_POINTS", "View", "cloud_of", "iterate_views", "view_cloud"]

SIGMA_S = DescriptorConfig().sigma_s

MIN_POINTS = 30
"""Views with fewer points are flagged `sparse`: too little of the object is seen to describe it."""

CHUNK = 128
"""Views a task of the pool: long against sending a mesh and indexing it (0.03 s), short against its 2,664 views."""

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]


def cloud_of(view: RenderedView) -> Cloud:
    """Back-project a rendered view and voxel it at 0.01 scaled units.

    Returns:
        xyz [n, 3] float32, metres, camera frame; rgb [n, 3] uint8. n may be 0.
    """
    # Metres in float32, all else in float64: every fourth millimetre lies on a border between voxels, and this is how
    # the clouds of the released pipeline fall on either side.
    depth = view.depth.astype(np.float32) / np.float32(1000)
    seen = view.depth > 0
    points = backproject(depth, view.intrinsics)[seen].astype(np.float64) * SIGMA_S
    points, colors = voxel_downsample(points, view.color[seen].astype(np.float64), VOXEL)
    return (points / SIGMA_S).astype(np.float32), np.rint(colors).astype(np.uint8)


def view_cloud(mesh: TexturedMesh, pose: NDArray[np.float64], camera: Camera = TRAINING_CAMERA) -> Cloud:
    """The training cloud of one view: rendered, depth in steps of 1 mm, back-projected, voxelled at 0.01 scaled units.

    Indexes the mesh anew at every call; for many views use `iterate_views`.

    Args:
        mesh: metres, z up.
        pose: [4, 4] camera to object frame, as from `camera_pose`.
        camera: 800 x 600 pixels, 40 degrees by default.

    Returns:
        xyz [n, 3] float32, metres, camera frame; rgb [n, 3] uint8.

    Raises:
        InputError: nothing of the mesh is seen.
    """
    xyz, rgb = cloud_of(render_view(RayCaster([mesh]), pose, camera))
    if len(xyz) == 0:
        raise InputError("the camera at this pose sees nothing of the mesh")
    return xyz, rgb


@dataclasses.dataclass(frozen=True)
class View:
    """One view of one object.

    Attributes:
        name: of the object.
        azimuth: radians.
        polar: radians.
        xyz: [n, 3] float32, metres, camera frame.
        rgb: [n, 3] uint8.
    """

    name: str
    azimuth: float
    polar: float
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]

    @property
    def sparse(self) -> bool:
        """Fewer than `MIN_POINTS` points: leave the view out of a training set, and say so."""
        return len(self.xyz) < MIN_POINTS


def _render_chunk(name: str, mesh: TexturedMesh, angles: NDArray[np.float64]) -> list[View]:
    caster, centre = RayCaster([mesh]), mesh.centre
    views = []
    for azimuth, polar in angles.tolist():
        xyz, rgb = cloud_of(render_view(caster, camera_pose(azimuth, polar, centre)))
        views.append(View(name, azimuth, polar, xyz, rgb))
    return views


def iterate_views(meshes: Mapping[str, TexturedMesh], angles: NDArray[np.float64], workers: int = 1) -> Iterator[View]:
    """Views of all meshes: all angles of the first mesh in order, then of the second, and so on.

    Order and values do not depend on the number of workers.

    Args:
        meshes: object name -> mesh.
        angles: [n, 2] azimuth and polar angle in radians, as from `view_angles`.
        workers: processes; 1 renders in this one. With more, the calling script needs the `if __name__ == "__main__"`
            guard of `multiprocessing`.

    Raises:
        InputError: `workers` is not positive.
    """
    if workers < 1:
        raise InputError(f"workers must be at least 1, not {workers}")
    return _generate_views(meshes, angles, workers)


def _generate_views(meshes: Mapping[str, TexturedMesh], angles: NDArray[np.float64], workers: int) -> Iterator[View]:
    chunks = [(name, angles[i : i + CHUNK]) for name in meshes for i in range(0, len(angles), CHUNK)]
    if workers == 1:
        for name, part in chunks:
            yield from _render_chunk(name, meshes[name], part)
        return
    # Not forked: JAX has threads, and a copy of them in a child can hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(chunks) or 1), mp_context=context)
    try:
        pending: collections.deque[Future[list[View]]] = collections.deque()
        for name, part in chunks:
            pending.append(pool.submit(_render_chunk, name, meshes[name], part))
            if len(pending) > 2 * workers:
                yield from pending.popleft().result()
        while pending:
            yield from pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
