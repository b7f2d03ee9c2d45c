"""Cluttered table scenes of known objects, rendered with labels: what a recognizer trained on single views is tried on.

    scene = compose_scene(builtin_objects(), np.random.default_rng(0))
    scene.frame, scene.truth[1], scene.visible[1], scene.occlusion(1)

The table is the plane z = 0; objects rest on it, apart from one another, and hide one another from a camera that looks down.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from thor2_jax.errors import InputError
from thor2_jax.frames import Intrinsics, RGBDFrame
from training.meshes import TexturedMesh
from training.rendering import Camera, RayCaster, pixel_rays, render_view
from training.view_sphere import camera_pose

__all__ = ["SCENE_CAMERA", "Scene", "compose_scene"]

SCENE_CAMERA = Camera(640, 480, Intrinsics(615.0, 615.0, 319.5, 239.5))
"""Like a small active-stereo camera at VGA size: 55 degrees across."""

MIN_PIXELS = 50
"""Instances of which fewer are seen are not labelled."""

GAP = 0.006
"""Least distance between two objects' footprints, metres."""

REACH = 0.20
"""Objects lie within this distance of the middle of the table, metres, unless there is no room."""

FARTHEST = 4.0
"""Metres; beyond it the sensor sees no depth."""

EDGE = 0.02
"""A step in depth between neighbouring pixels, metres, from which on depth may be missing."""

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A frame and what is in it.

    Attributes:
        frame: colour, depth in millimetres, labels from 1 in no order; table and background are 0.
        truth: label -> object name.
        visible: label -> share of the pixels the object would fill alone that show it, in (0, 1].
    """

    frame: RGBDFrame
    truth: Mapping[int, str]
    visible: Mapping[int, float]

    def occlusion(self, label: int) -> str:
        """How much of an instance is hidden: "none" (up to 5 %), "low" (up to 30 %) or "high"."""
        share = self.visible[label]
        return "none" if share > 0.95 else "low" if share > 0.7 else "high"


def _turned(turn: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    return matrix


def _yaw(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


# The stored pose first, then each side down.
TURNS = tuple(
    np.array(rows, np.float64)
    for rows in (
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    )
)


def _rests(hull: Array) -> bool:
    """Whether a body with these hull vertices [n, 3] stays as it is when put down: its middle is above what touches the table.

    What is within 3 mm of the table counts as touching it, and the middle must be 5 mm inside; so a can rests on its side.
    """
    feet = hull[hull[:, 2] < hull[:, 2].min() + 0.003, :2]
    if len(feet) < 3 or (np.ptp(feet, axis=0) < 0.01).any():
        return False
    middle = (hull.min(axis=0) + hull.max(axis=0))[:2] / 2
    sides = ConvexHull(feet, qhull_options="QJ Pp").equations
    return bool((sides[:, :2] @ middle + sides[:, 2] < -0.005).all())


def _posed(mesh: TexturedMesh, rng: np.random.Generator) -> TexturedMesh:
    """As stored three times out of five, else on a side it can rest on; any yaw; lowest point at z = 0, middle above the origin."""
    hull = mesh.vertices[ConvexHull(mesh.vertices[np.unique(mesh.faces)]).vertices] if len(mesh.vertices) > 3 else None
    raise NotImplementedError(hull)
