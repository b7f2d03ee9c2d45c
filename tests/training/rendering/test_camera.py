"""Camera poses against spherical coordinates, and ray casting against Cyrus and Beck in float64."""

import math

import numpy as np
import pytest
import trimesh
from refusals import assert_refused
from rendered_objects import full_image
from segmentation_scenes import surface

from thor2_jax.frames.frames import Intrinsics
from training.rendering.camera import DISTANCE, Camera, RayCaster, camera_pose, pixel_rays, random_angles, view_angles

CAMERA = Camera.from_field_of_view(161, 121, 30.0)
RED = (200, 30, 40)


def test_default_views_are_the_papers() -> None:
    angles = view_angles()
    assert angles.shape == (72 * 37, 2)
    assert angles[0].tolist() == [0, 0] and angles[71] == pytest.approx([math.radians(355), 0])
    assert angles[72] == pytest.approx([0, math.radians(5)]) and angles[-1, 1] == pytest.approx(math.pi)
    assert len(np.unique(angles.round(9), axis=0)) == len(angles)
    for azimuth_step, polar_step, count in ((360, 180, 2), (180, 90, 6), (22.5, 0.9, 16 * 201)):
        assert len(view_angles(azimuth_step, polar_step)) == count


def test_seven_of_ten_random_views_look_down_or_from_the_side() -> None:
    rng = np.random.default_rng(0)
    heights = np.cos([random_angles(rng)[1] for _ in range(10_000)])
    # The others are distributed evenly: .3 of 0.85, 1.12 and 0.03 in 2.
    counts, _ = np.histogram(heights, [-1, -0.15, 0.97, 1])
    assert counts == pytest.approx([1275, 8680, 45], abs=100)


def test_invalid_steps_are_refused() -> None:
    for step in (0.0, -5.0, 7.0, math.nan, math.inf, 400.0, 1e-320):
        assert_refused("^azimuth_step is", view_angles, step, 5.0)
        assert_refused("^polar_step is", view_angles, 5.0, step)
    for steps in ((1e-9, 5), (5, 1e-9), (0.1, 0.1)):  # too many views
        assert_refused("azimuth_step .* polar_step", view_angles, *steps)


@pytest.mark.parametrize(("azimuth", "polar"), [(0, 0), (1.0, 0), (0.3, 1.1), (4.0, 2.5), (2.0, math.pi)])
def test_camera_pose(azimuth: float, polar: float) -> None:
    """The camera looks at the centre; z is up in the image, which is turned by the azimuth at the poles."""
    centre = np.array([0.1, -0.2, 0.3])
    outward = [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]
    right = [-math.sin(azimuth), math.cos(azimuth), 0]
    pose = camera_pose(azimuth, polar, centre)
    np.testing.assert_allclose(pose[:3, :3].T, [right, np.cross(right, outward), np.negative(outward)], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], centre + DISTANCE * np.array(outward), atol=1e-12)
    assert pose[3].tolist() == [0, 0, 0, 1] and (pose[2, 1] < 0 or polar in (0, math.pi))


def intersect_convex(shape: trimesh.Trimesh, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the depth along each ray with the algorithm of Cyrus and Beck in float64; 0 without a hit."""
    towards = rays @ shape.face_normals.T
    depth = ((shape.triangles[:, 0] - origin) * shape.face_normals).sum(axis=1) / towards
    enter, leave = np.where(towards < 0, depth, -np.inf).max(axis=1), np.where(towards > 0, depth, np.inf).min(axis=1)
    return np.where((enter > leave) | (leave < 0), 0, np.where(enter > 0, enter, leave))


@pytest.mark.parametrize(("azimuth", "polar", "distance"), [(2.0, 1.9, 0.6), (0.0, 2.5, 0.02)])
def test_matches_another_intersector_and_crops_nothing_visible(azimuth: float, polar: float, distance: float) -> None:
    """The camera may be inside the object."""
    camera = Camera(161, 121, Intrinsics(300.0, 280.0, 60.0, 80.0))
    shape = trimesh.creation.capsule(height=0.12, radius=0.03, count=[12, 12])
    shape.apply_translation([0.02, -0.01, 0.03])
    pose = camera_pose(azimuth, polar, np.array([0.0, 0.01, 0.05]), distance)
    view = RayCaster([surface(shape, RED)]).render(pose, camera)
    assert (view.depth.size < camera.width * camera.height / 2) == (distance > 0.1)
    _, depth = full_image(view, camera)
    rays = pixel_rays(camera.intrinsics, camera.height, camera.width, pose)
    expected = intersect_convex(shape, pose[:3, 3], rays).reshape(depth.shape)
    assert np.array_equal(depth > 0, expected > 0)
    assert np.abs(depth - expected * 1000).max() <= 0.501


def test_objects_outside_the_image_and_cameras_inside_an_object() -> None:
    mesh = surface(trimesh.creation.box([0.1] * 3), RED)
    for centre in ([0, 5.0, 0], [0, 0, -5.0], [0, 3.0, 9.0]):
        view = RayCaster([mesh]).render(camera_pose(0.0, 1.5, np.array(centre)), CAMERA)
        assert not view.depth.any() and not view.color.any()
    view = RayCaster([surface(trimesh.creation.box([1.0] * 3), RED)]).render(np.eye(4), CAMERA)
    assert view.depth.shape == (CAMERA.height, CAMERA.width) and set(np.unique(view.depth)) == {500}
    assert view.corner == (0, 0) and view.intrinsics == CAMERA.intrinsics
