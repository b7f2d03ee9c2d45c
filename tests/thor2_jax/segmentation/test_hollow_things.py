"""Bowls and cups: their inner side, bottom and outer side are one thing."""

from typing import Any

import numpy as np
import pytest
import trimesh
from segmentation_scenes import CAMERA, TABLE_TOP, best_overlaps, camera_pose, cast, surface

from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.segmentation.table import segment_table

WHITE, RED = (225, 225, 220), (170, 60, 50)
LIGHT = np.array([0.3, -0.2, 0.93])
BOWL = [(0, 0), (0.04, 0), (0.07, 0.03), (0.08, 0.06), (0.076, 0.06), (0.066, 0.03), (0.038, 0.006), (0, 0.006)]
CUP = [(0, 0), (0.04, 0), (0.04, 0.1), (0.036, 0.1), (0.036, 0.006), (0, 0.006)]


def revolved(profile: list[tuple[float, float]], x: float, color: Any, inside: Any = None) -> Any:
    """Return the solid of revolution of a closed profile (radius, height), at `x`."""
    mesh = trimesh.creation.revolve(np.array([*profile, profile[0]]), sections=48)
    is_inside = np.linalg.norm(mesh.triangles_center[:, :2], axis=1, keepdims=True) < 0.0385
    mesh.apply_translation([x, 0, 0])
    light = 0.55 + 0.45 * np.clip(mesh.face_normals @ LIGHT, 0, 1)
    return surface(mesh, np.where(is_inside, color if inside is None else inside, color) * light[:, None])


@pytest.mark.parametrize("tilt", [40, 50, 60])
def test_bowls_and_cups_are_one_thing_each(tilt: float) -> None:
    things = [revolved(BOWL, -0.15, WHITE), revolved(CUP, 0.02, RED, inside=WHITE), revolved(BOWL, 0.2, RED)]
    hits = cast([TABLE_TOP, *things], camera_pose(tilt), 0.8, CAMERA, (240, 320))
    depth, truth = (values.reshape(240, 320) for values in (np.rint(hits.distance * 1000), hits.mesh))
    frame = RGBDFrame(hits.color.reshape(240, 320, 3), depth.astype(np.uint16), truth, CAMERA)
    # At the foot of a bowl, which is in the shade below its rim, a sliver may be a piece of its own.
    assert (best_overlaps(segment_table(frame), frame.label_image) > 0.8).all()
