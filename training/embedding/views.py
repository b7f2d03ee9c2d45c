"""Views that an embedding is fitted on: random cameras and stronger augmentation than for classifiers.

An embedding is used on cameras and objects that it never saw; a classifier is fitted on its own objects.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from thor2_jax.types import Cloud
from training.augmentation.augmentations import Augmentations, augment
from training.augmentation.base import Base
from training.augmentation.illumination import Illumination
from training.augmentation.occlusion import Occlusion
from training.augmentation.registration import Registration
from training.augmentation.segmentation import Segmentation
from training.augmentation.sensor import Sensor
from training.objects.meshes import load_mesh
from training.objects.procedural import procedural_object
from training.rendering.camera import Camera
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import camera_pose
from training.views.mesh_views import MIN_VIEW_POINTS, cloud_of

__all__ = ["AUGMENTATIONS", "ObjectSource", "ViewTask", "render_clouds"]

AUGMENTATIONS = Augmentations(
    illumination=Illumination(gamma=(0.6, 1.6), gain=(0.4, 1.7), cast=0.15, saturation=(0.4, 1.7), veil=(0.0, 0.12)),
    sensor=Sensor(axial=(0.3, 1.5)),
    occlusion=Occlusion(none=0.45),
    segmentation=Segmentation(),
    registration=Registration(),
    base=Base(),
)

UNCHANGED = 0.2
"""Share of views without augmentation."""

CAMERA = Camera.from_field_of_view(540, 405, 40.0)
"""Half the pixels of the training camera: still two for each voxel of a cloud."""

FROM_ABOVE = 0.7
"""Share of views whose camera looks down on the object or is slightly below its middle, as on a table."""

ObjectSource = int | Path
"""The seed of a procedural object, or a mesh file."""


@dataclasses.dataclass(frozen=True)
class ViewTask:
    """Views of some objects, to be rendered by one process.

    Attributes:
        sources: index -> object.
        views: number of views of each object.
        seed: seed for cameras and augmentations, with the index.
    """

    sources: Mapping[int, ObjectSource]
    views: int
    seed: int


def _random_angles(rng: np.random.Generator) -> tuple[float, float]:
    low, high = (-0.15, 0.97) if rng.random() < FROM_ABOVE else (-1.0, 1.0)
    return rng.uniform(0, 2 * np.pi), float(np.arccos(rng.uniform(low, high)))


def render_clouds(task: ViewTask) -> list[tuple[int, Cloud]]:
    """Return the object's index and the cloud of the views that have at least `MIN_VIEW_POINTS` points.

    Raises:
        InputError: a mesh is unreadable.
    """
    clouds = []
    for index, source in task.sources.items():
        mesh = load_mesh(source) if isinstance(source, Path) else procedural_object(source)
        caster = RayCaster([mesh])
        rng = np.random.default_rng([task.seed, index])
        for _ in range(task.views):
            view = render_view(caster, camera_pose(*_random_angles(rng), mesh.centre), CAMERA)
            cloud = cloud_of(view if rng.random() < UNCHANGED else augment(view, AUGMENTATIONS, rng))
            if len(cloud[0]) >= MIN_VIEW_POINTS:
                clouds.append((index, cloud))
    return clouds
