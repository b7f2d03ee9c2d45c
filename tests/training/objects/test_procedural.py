"""Procedural objects: deterministic, of the size of household objects, all visible, with siblings."""

import numpy as np
import pytest

from training.objects.procedural import _FAMILIES, SIZES, procedural_object
from training.rendering.camera import RayCaster, camera_pose

OBJECTS = [procedural_object(seed) for seed in range(60)]


def test_objects_stand_and_have_a_household_size() -> None:
    for mesh in OBJECTS:
        assert np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)
        np.testing.assert_allclose(mesh.vertices[:, 2].min(), 0, atol=1e-9)
        np.testing.assert_allclose(mesh.centre[:2], 0, atol=1e-9)
        assert SIZES[0] - 1e-9 <= np.ptp(mesh.vertices, axis=0).max() <= SIZES[1] * 1.0001


@pytest.mark.parametrize("family", _FAMILIES)
def test_every_family_is_visible_from_all_sides(family) -> None:
    texture = np.full((4, 4, 3), 90, np.uint8)
    for seed in range(5):
        mesh = family(np.random.default_rng(seed), lambda part: texture)
        for polar in (0.1, 1.5, 3.0):
            view = RayCaster([mesh]).render(camera_pose(0.3, polar, mesh.centre))
            assert (view.depth > 0).sum() > 20 and (view.color[view.depth > 0] == 90).all()


def test_siblings_share_shape_or_paint() -> None:
    for seed in range(0, len(OBJECTS), 5):
        first, second, third, fourth, _ = OBJECTS[seed : seed + 5]
        assert np.array_equal(first.vertices, second.vertices)
        assert not np.array_equal(first.textures[0], second.textures[0])
        assert np.array_equal(third.textures[0], fourth.textures[0])
        assert third.vertices.shape != fourth.vertices.shape or not np.allclose(third.vertices, fourth.vertices)
