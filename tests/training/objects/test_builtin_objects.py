"""The built-in objects: sizes, closed surfaces, and pairs that differ only in colour or only in shape."""

import numpy as np
import pytest
import trimesh
from small_clouds import NETWORK

from training.objects.builtin_objects import COLOR_PAIRS, SHAPE_PAIRS, builtin_objects
from training.objects.mesh import TexturedMesh

OBJECTS = builtin_objects()


def color_shares(mesh: TexturedMesh, n: int = 40_000) -> dict[tuple[int, ...], float]:
    """Return the share of the surface that each colour covers, estimated from uniform samples."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(shape, n, seed=0)
    weights = trimesh.triangles.points_to_barycentric(shape.triangles[face], points)[:, 1:]
    colors, counts = np.unique(mesh.colors_at(face, weights), axis=0, return_counts=True)
    return {tuple(color): count / n for color, count in zip(colors.tolist(), counts, strict=True) if count > n / 1000}


@pytest.mark.parametrize("name", OBJECTS)
def test_objects_have_plausible_sizes_and_closed_surfaces(name: str) -> None:
    """They stand on the ground, and all faces face outwards."""
    mesh = OBJECTS[name]
    size = np.ptp(mesh.vertices, axis=0)
    assert 0.05 < size.max() < 0.25 and size.min() > 0.015
    assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
    assert 12 <= len(mesh.faces) <= 6000
    assert len(color_shares(mesh)) >= 2
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    shape.merge_vertices(merge_tex=True, digits_vertex=7)
    shape.update_faces(shape.nondegenerate_faces())
    assert shape.is_watertight and shape.is_winding_consistent and shape.volume > 0


@pytest.mark.parametrize("pair", COLOR_PAIRS)
def test_pairs_that_differ_only_in_colour(pair: tuple[str, str]) -> None:
    one, other = (OBJECTS[name] for name in pair)
    assert np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces)

    def regions(mesh: TexturedMesh) -> np.ndarray:
        return sum(share * NETWORK.membership(np.array(c, np.uint8)) for c, share in color_shares(mesh).items())

    # The distance of two distributions over the colour regions is at most 2.
    assert np.abs(regions(one) - regions(other)).sum() > 0.8


@pytest.mark.parametrize("pair", SHAPE_PAIRS)
def test_pairs_that_differ_only_in_shape(pair: tuple[str, str]) -> None:
    one, other = (OBJECTS[name] for name in pair)
    shares, others = color_shares(one), color_shares(other)
    assert set(shares) == set(others)
    for color, share in shares.items():
        assert share == pytest.approx(others[color], abs=0.02)
    extents = [np.sort(np.ptp(mesh.vertices, axis=0)) for mesh in (one, other)]
    assert np.abs(extents[0] - extents[1]).max() > 0.03
