"""Bowls and cups: their inner side, bottom and outer side are one thing."""

import numpy as np
import pytest
import trimesh
from segmentation_scenes import best_overlaps, camera_pose

from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.segmentation.table import segment_table

WHITE, RED = (225, 225, 220), (170, 60, 50)
LIGHT = np.array([0.3, -0.2, 0.93])


def revolved(profile: list[tuple[float, float]], x: float) -> trimesh.Trimesh:
    """Return the solid of revolution of a closed profile (radius, height), at `x`."""
    mesh = trimesh.creation.revolve(np.array([*profile, profile[0]]), sections=48)
    mesh.apply_translation([x, 0, 0])
    return mesh


def bowl(x: float) -> trimesh.Trimesh:
    return revolved(
        [(0, 0), (0.04, 0), (0.07, 0.03), (0.08, 0.06), (0.076, 0.06), (0.066, 0.03), (0.038, 0.006), (0, 0.006)], x
    )


def cup(x: float) -> trimesh.Trimesh:
    return revolved([(0, 0), (0.04, 0), (0.04, 0.1), (0.036, 0.1), (0.036, 0.006), (0, 0.006)], x)


@pytest.mark.parametrize("tilt", [40, 50, 60])
def test_bowls_and_cups_are_one_thing_each(tilt: float) -> None:
    things = [(bowl(-0.15), WHITE), (cup(0.02), RED), (bowl(0.2), RED)]
    rotation, camera = camera_pose(tilt), Intrinsics(290.0, 290.0, 159.5, 119.5)
    row, column = np.mgrid[:240, :320]
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(row.shape)], axis=-1)
    directions = rays.reshape(-1, 3) @ rotation.as_matrix().T
    origin = -0.8 * rotation.apply([0, 0, 1])
    depth = -origin[2] / directions[:, 2]
    truth, light = np.zeros(len(depth), np.int32), np.ones(len(depth))
    inside = np.zeros(len(depth), bool)
    for number, (mesh, _) in enumerate(things, start=1):
        points, ray, face = mesh.ray.intersects_location(
            np.broadcast_to(origin, directions.shape), directions, multiple_hits=False
        )
        z = ((points - origin) * directions[ray]).sum(axis=1) / (directions[ray] ** 2).sum(axis=1)
        near = z < depth[ray]
        depth[ray[near]], truth[ray[near]] = z[near], number
        inside[ray[near]] = np.linalg.norm(points[near, :2] - mesh.centroid[:2], axis=1) < 0.0385
        light[ray[near]] = 0.55 + 0.45 * np.clip(mesh.face_normals[face[near]] @ LIGHT, 0, 1)
    color = np.array([(150, 120, 90), *(color for _, color in things)])[truth]
    color[inside & (truth == 2)] = WHITE  # the cup is white inside
    color = color * light[:, None]
    frame = RGBDFrame(
        color.astype(np.uint8).reshape(240, 320, 3),
        np.rint(depth * 1000).astype(np.uint16).reshape(240, 320),
        truth.reshape(240, 320),
        camera,
    )
    # At the foot of a bowl, which is in the shade below its rim, a sliver may be a piece of its own.
    assert (best_overlaps(segment_table(frame), frame.label_image) > 0.8).all()
