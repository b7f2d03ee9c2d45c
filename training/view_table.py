"""Table of rendered views of the classes and their answers, from which `next_view` chooses a viewpoint."""

import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from thor2_jax import InputError, Recognizer
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.printable import first_names
from thor2_jax.tracking.viewpoints import ViewTable
from training.objects.mesh import TexturedMesh
from training.views.mesh_views import ViewTask, all_views, cloud_of

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
    angles = np.array(list(itertools.product(POLARS, np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS)))[:, ::-1]
    labels: list[int] = []
    rotations: list[NDArray[np.float64]] = []
    views: list[PreparedInstance] = []
    for name in [name for name in meshes if name in classes]:
        for _, _, view in all_views(ViewTask(name, meshes[name], angles)):
            xyz, rgb = cloud_of(view)
            views.append(PreparedInstance(len(views), xyz, rgb, np.zeros(len(xyz), bool)))
            labels.append(classes.index(name))
            rotations.append(view.pose[:3, :3])
    if not views:
        raise InputError(f"meshes has none of the classes {first_names(classes)}; expected some of them")
    _, inference = recognizer.infer(views, answer_by="classifiers")
    probabilities = {name: values[: len(views)] for name, values in inference.probabilities.items()}
    return ViewTable(np.array(labels), np.array(rotations), recognizer.model.fused(probabilities).astype(np.float64))
