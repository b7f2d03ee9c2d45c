"""Views of meshes to enroll in a gallery, rendered without JAX, so that a process that renders starts quickly."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance
from training.augmentation.augmentations import KINDS, Augmentations
from training.objects.mesh import TexturedMesh
from training.objects.meshes import load_mesh
from training.views.mesh_views import ViewTask, render_task

__all__ = ["MESH_VIEWS", "mesh_views"]

MESH_VIEWS = 60
"""Cameras around a mesh. Each gives two views: the mesh as rendered, and an augmented rendering from another camera."""


def _evenly_spread(count: int) -> NDArray[np.float64]:
    """Return azimuth and polar angle [count, 2] of directions that cover the sphere evenly (a Fibonacci spiral)."""
    index = np.arange(count)
    golden_angle = np.pi * (3 - np.sqrt(5))
    return np.stack([index * golden_angle % (2 * np.pi), np.arccos(1 - (2 * index + 1) / count)], axis=1)


def mesh_views(mesh: Path | TexturedMesh, mesh_scale: float = 1.0, cameras: int = MESH_VIEWS) -> list[PreparedInstance]:
    """Render a mesh from all sides: two views for each of `cameras`. `mesh_scale` converts a file's unit to metres.

    Raises:
        InputError: the mesh cannot be read, is too large or too small to be in metres, or has no usable view.
        OSError: the file cannot be opened.
    """
    name, loaded = (mesh.name, load_mesh(mesh, mesh_scale)) if isinstance(mesh, Path) else ("mesh", mesh)
    augmentations = Augmentations.of_names(KINDS, copies=1)
    task = ViewTask(name, loaded, _evenly_spread(cameras), augmentations=augmentations)
    clouds = enumerate(render_task(task))
    views = [PreparedInstance(k, cloud.xyz, cloud.rgb, np.zeros(len(cloud.xyz), bool)) for k, cloud in clouds]
    if not views:
        raise InputError(f"mesh: {name} has too few points in every view; expected an object of a few centimetres")
    return views
