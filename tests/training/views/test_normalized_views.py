"""Random orientations of normalized views: the axes, and what a reoriented cloud keeps."""

from pathlib import Path

import numpy as np
from small_clouds import random_clouds

import thor2_jax as thor2
from training.views.normalized_views import MemoryViews, _random_axes, reorient, sequence_sources


def test_random_axes_are_rotations_that_swap_nearly_equal_sides() -> None:
    """Swaps of the first two sides, of the last two, and none; then up to 10 degrees about any axis."""
    sides = np.repeat(np.array([[1, 0.9, 0.2], [1, 0.5, 0.45], [1, 0.5, 0.2]], np.float32), 400, axis=0)
    axes = _random_axes(sides, np.random.default_rng(0))
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2), np.tile(np.eye(3), (1200, 1, 1)), atol=1e-5)
    kept = np.diagonal(axes, axis1=1, axis2=2).reshape(3, 400, 3) > np.cos(np.radians(10.1))
    np.testing.assert_allclose(kept.mean(axis=1), [[0.5, 0.5, 1], [1, 0.5, 0.5], [1, 1, 1]], atol=0.1)
    np.testing.assert_allclose(axes[800:].min(axis=0).diagonal(), np.cos(np.radians(10)), atol=2e-3)


def test_reoriented_clouds_are_rigid_and_in_the_first_octant() -> None:
    clouds = thor2.PointClouds.pack([*random_clouds(3, [200], (0.2, 0.19, 0.1)) * 4, *random_clouds(3, [200]) * 4])
    normal = thor2.view_normalize(clouds, thor2.DescriptorConfig())
    turned = reorient(normal, np.random.default_rng(3))
    assert len({np.asarray(cloud).tobytes() for cloud in turned.points}) == 8
    both = [np.concatenate([each.points[:, :200], each.camera[:, None]], axis=1) for each in (turned, normal)]
    # Some of those without a swap are mirrored.
    assert 0 < np.diff([np.linalg.det(np.diff(a[4:, :4], axis=1)) > 0 for a in both], axis=0).mean() < 1
    for cloud, before in zip(*both, strict=True):
        np.testing.assert_allclose(cloud[:200].min(axis=0), 0, atol=1e-5)
        assert cloud[200, 2] <= cloud[:200, 2].max() / 2  # the camera is on the side of -z
        distances = [np.linalg.norm(a[:100] - a[101:], axis=1) for a in (cloud, before)]
        np.testing.assert_allclose(*distances, atol=1e-4)
    np.testing.assert_array_equal(turned.colors, normal.colors)


def test_sequences_find_objects_in_other_unicode_forms(tmp_path: Path) -> None:
    table = tmp_path / "table.json"
    table.write_text('{"seq": ["cafe\\u0301", "mug"]}')
    source = MemoryViews({"caf\u00e9": [], "mug": [], "box": []}, thor2.DescriptorConfig())
    (views,) = sequence_sources(source, table, tmp_path).values()
    assert views.classes == ("caf\u00e9", "mug")
