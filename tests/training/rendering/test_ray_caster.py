"""Ray casting against Moeller and Trumbore in float64."""

import numpy as np
import pytest
import trimesh
from rendered_objects import full_image

from thor2_jax.frames.frames import Intrinsics
from training.objects.mesh import TexturedMesh
from training.rendering.ray_caster import RayCaster, pixel_rays, render_view
from training.rendering.view_sphere import Camera, camera_pose

CAMERA = Camera.from_field_of_view(161, 121, 30.0)


def painted(shape: trimesh.Trimesh, color: tuple[int, int, int] = (200, 30, 40)) -> TexturedMesh:
    colors = np.tile(np.array(color, np.uint8), (len(shape.faces), 3, 1))
    return TexturedMesh(np.array(shape.vertices), np.array(shape.faces, np.int32), corner_colors=colors)


def intersect_triangles(shape: trimesh.Trimesh, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the depth along each ray with the algorithm of Moeller and Trumbore in float64; 0 without a hit."""
    nearest = np.full(len(rays), np.inf)
    for a, b, c in shape.triangles:
        p = np.cross(rays, c - a)
        q = np.cross(origin - a, b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (p @ (b - a))
            u, v, t = p @ (origin - a) * inverse, rays @ q * inverse, (c - a) @ q * inverse
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < nearest)
        nearest[hit] = t[hit]
    return np.where(np.isinf(nearest), 0, nearest)


def test_field_of_view() -> None:
    k = CAMERA.intrinsics
    assert (k.cx, k.cy) == (80, 60) and k.fx == k.fy
    # The borders of the image, half a pixel beyond the outer pixel centres, are at half the angle.
    assert np.degrees(np.arctan(80.5 / k.fx)) == pytest.approx(15)


def test_matches_another_intersector_and_crops_nothing_visible() -> None:
    camera = Camera(161, 121, Intrinsics(300.0, 280.0, 60.0, 80.0))
    shape = trimesh.creation.capsule(height=0.12, radius=0.03, count=[12, 12])
    shape.apply_translation([0.02, -0.01, 0.03])
    pose = camera_pose(2.0, 1.9, np.array([0.0, 0.01, 0.05]), 0.6)
    view = render_view(RayCaster([painted(shape)]), pose, camera)
    assert view.depth.size < camera.width * camera.height / 2
    _, depth = full_image(view, camera)
    rays = pixel_rays(camera.intrinsics, camera.height, camera.width, pose)
    expected = intersect_triangles(shape, pose[:3, 3], rays)
    expected = expected.reshape(depth.shape)
    assert np.array_equal(depth > 0, expected > 0)
    assert np.abs(depth - expected * 1000).max() <= 0.501


def test_nearest_mesh_is_hit_and_named() -> None:
    near, far = painted(trimesh.creation.box([0.1] * 3), (1, 2, 3)), painted(trimesh.creation.box([0.3] * 3), (9, 8, 7))
    near.vertices[:, 0] += 0.5
    hits = RayCaster([far, near]).cast(np.array([2.0, 0, 0]), np.array([[-1.0, 0, 0], [-2, 0.1, 0], [1, 0, 0]]))
    assert hits.mesh.tolist() == [1, 0, -1]
    assert hits.color.tolist() == [[1, 2, 3], [9, 8, 7], [0, 0, 0]]
    assert hits.distance.tolist() == pytest.approx([1.45, 0.925, np.inf])


def test_no_rays() -> None:
    hits = RayCaster([painted(trimesh.creation.box([0.1] * 3))]).cast(np.zeros(3), np.zeros((0, 3)))
    assert hits.distance.shape == (0,) and hits.color.shape == (0, 3)


def test_an_object_outside_the_image_leaves_it_empty() -> None:
    mesh = painted(trimesh.creation.box([0.1] * 3))
    for centre in ([0, 5.0, 0], [0, 0, -5.0], [0, 3.0, 9.0]):
        view = render_view(RayCaster([mesh]), camera_pose(0.0, 1.5, np.array(centre)), CAMERA)
        assert not view.depth.any() and not view.color.any()


def test_camera_inside_the_bounding_box_sees_the_whole_image() -> None:
    view = render_view(RayCaster([painted(trimesh.creation.box([1.0] * 3))]), np.eye(4), CAMERA)
    assert view.depth.shape == (CAMERA.height, CAMERA.width) and set(np.unique(view.depth)) == {500}
    assert view.corner == (0, 0) and view.intrinsics == CAMERA.intrinsics
