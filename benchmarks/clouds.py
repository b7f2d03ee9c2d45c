"""Clouds for benchmarks: views of real scans if available, otherwise of the built-in objects."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.frames import backproject
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh
from training.objects.meshes import find_meshes, load_mesh
from training.rendering.camera import RayCaster, camera_pose, render_view

__all__ = ["SCANS", "sample_clouds"]

SCANS = Path(__file__).resolve().parents[2] / "shared" / "data" / "meshes"
N_OBJECTS, N_VIEWS = 24, 8

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]


def _objects() -> tuple[str, list[TexturedMesh]]:
    if SCANS.is_dir():
        paths = list(find_meshes(SCANS).values())
        step = max(1, len(paths) // N_OBJECTS)
        return "views of real scans", [load_mesh(path) for path in paths[::step][:N_OBJECTS]]
    return "views of built-in objects", list(builtin_objects().values())


def sample_clouds(count: int, n_points: int, seed: int = 0) -> tuple[str, list[Cloud]]:
    """Return a description of the clouds, and `count` clouds of exactly `n_points` points.

    Points are drawn at random from the pixels of a view, without repetition if there are enough pixels. If there are
    fewer views than clouds, views are reused with other random points.
    """
    rng = np.random.default_rng(seed)
    name, meshes = _objects()
    views = []
    for mesh in meshes:
        caster = RayCaster([mesh])
        for _ in range(N_VIEWS):
            pose = camera_pose(rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 2.8), mesh.centre)
            view = render_view(caster, pose)
            seen = view.depth > 0
            points = backproject(view.depth.astype(np.float32) / np.float32(1000), view.intrinsics)[seen]
            views.append((points, view.color[seen]))
    clouds = []
    for k in range(count):
        points, colors = views[k % len(views)]
        pick = rng.choice(len(points), n_points, replace=len(points) < n_points)
        clouds.append((points[pick], colors[pick]))
    return name, clouds
