"""Table of rendered views of the classes and their answers, from which `next_view` chooses a viewpoint."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from thor2_jax import InputError, Recognizer
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.tracking.viewpoints import ViewTable
from training.objects.mesh import TexturedMesh
from training.rendering.camera import RayCaster, camera_pose, render_view
from training.views.mesh_views import cloud_of

__all__ = ["view_table"]

AZIMUTHS, POLARS = 8, (0.6, 1.2)
"""Number of azimuths, and polar angles in radians: cameras around a table look down on it."""


def view_table(recognizer: Recognizer, meshes: Mapping[str, TexturedMesh]) -> ViewTable:
    """Render views of the trained classes from cameras above and all around, and recognize them.

    Args:
        recognizer: a recognizer with classifiers.
        meshes: name -> mesh, in metres, z up; at least one must be of a trained class.

    Raises:
        InputError: no mesh is of a trained class.
    """
    classes = recognizer.run.classes
    labels: list[int] = []
    rotations: list[NDArray[np.float64]] = []
    views: list[PreparedInstance] = []
    for name, mesh in meshes.items():
        if name not in classes:
            continue
        caster = RayCaster([mesh])
        for polar in POLARS:
            for azimuth in np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS:
                pose = camera_pose(float(azimuth), polar, mesh.centre)
                xyz, rgb = cloud_of(render_view(caster, pose))
                views.append(PreparedInstance(len(views), xyz, rgb, np.zeros(len(xyz), bool)))
                labels.append(classes.index(name))
                rotations.append(pose[:3, :3])
    if not views:
        raise InputError(
            f"meshes has none of the classes {', '.join(classes[:5])}, ...; expected meshes of the classes"
        )
    _, inference = recognizer.infer(views, answer_by="classifiers")
    probabilities = {name: values[: len(views)] for name, values in inference.probabilities.items()}
    return ViewTable(np.array(labels), np.array(rotations), recognizer.model.fused(probabilities).astype(np.float64))
