"""Surfaces of meshes: samples, grids of nearest samples and visible parts, against analytic values and scipy."""

import dataclasses

import numpy as np
import trimesh
from scipy.spatial import KDTree

from colornet.colors import MEAN_WHITE, to_lab
from thor2_jax.surfaces.surfaces import FAR, GRID, rotations
from training.objects.mesh import TexturedMesh
from training.objects.surfaces import surfaces_of

RADIUS = 0.05


def sphere(color: tuple[int, int, int], centre: tuple[float, float, float]) -> TexturedMesh:
    shape = trimesh.creation.icosphere(5, RADIUS)
    colors = np.broadcast_to(np.array(color, np.uint8), (len(shape.faces), 3, 3))
    return TexturedMesh(shape.vertices + centre, shape.faces.astype(np.int32), corner_colors=colors)


def test_a_sphere() -> None:
    """Its samples, the nearest sample of each cell, and the parts that are visible from all directions."""
    centre = (0.2, -0.1, 0.3)
    surfaces = surfaces_of([sphere((200, 40, 90), centre), sphere((10, 120, 60), (0, 0, 0))])
    assert surfaces.nearest.shape == (2, GRID**3) and surfaces.boxes.shape == (2, len(rotations()), 3, 3)
    for row, color in enumerate(((200, 40, 90), (10, 120, 60))):
        points, lab, normals = np.split(np.asarray(surfaces.table[row], np.float64).T, 3, axis=1)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), RADIUS, rtol=2e-3)
        np.testing.assert_allclose(points.mean(axis=0), 0, atol=0.03 * RADIUS)  # spread evenly
        np.testing.assert_allclose(normals, points / RADIUS, atol=0.05)
        assert np.abs(lab - to_lab(np.array(color, np.uint8), MEAN_WHITE)).max() < 0.05
        cell = np.random.default_rng(row).integers(0, GRID, (1000, 3))
        low, side = np.asarray(surfaces.grid[row])
        at = low + (cell + 0.5) * side
        distance = np.linalg.norm(points[np.asarray(surfaces.nearest[row])[cell @ [GRID**2, GRID, 1]]] - at, axis=1)
        np.testing.assert_allclose(distance, KDTree(points).query(at)[0], atol=1e-6)
        low, mean, high = np.moveaxis(np.asarray(surfaces.boxes[row]), 1, 0)
        np.testing.assert_allclose(low, -RADIUS, rtol=0.02)
        np.testing.assert_allclose(high, RADIUS, rtol=0.02)
        # The mean of the visible half, weighted by its projected area, is 2/3 of the radius before the centre.
        np.testing.assert_allclose(mean, np.broadcast_to([0, 0, -2 / 3 * RADIUS], mean.shape), atol=0.04 * RADIUS)


def test_rotations_are_proper_and_look_from_all_sides() -> None:
    matrices = rotations().astype(np.float64)
    np.testing.assert_allclose(matrices @ matrices.mT, np.broadcast_to(np.eye(3), matrices.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(matrices), 1, atol=1e-6)
    anywhere = np.random.default_rng(0).standard_normal((1000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1, keepdims=True)
    assert np.degrees(np.arccos((anywhere @ matrices[:, 2].T).max(axis=1))).max() < 30


def test_a_triangle() -> None:
    """Points are spread evenly over it and have its colours; the faces of a mesh may all be inside out."""
    vertices = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.1, 0]])
    colors = np.array([[[0, 0, 0], [255, 0, 0], [0, 0, 255]]], np.uint8)
    mesh = TexturedMesh(vertices, np.array([[0, 1, 2]], np.int32), corner_colors=colors)
    surfaces = surfaces_of([mesh])
    points, lab, _ = np.split(np.asarray(surfaces.table[0], np.float64).T, 3, axis=1)
    weights = (points + mesh.centre)[:, :2] / [0.2, 0.1]  # of the second and third corner
    assert (weights > -1e-6).all() and (weights.sum(axis=1) < 1 + 1e-6).all()
    np.testing.assert_allclose(weights.mean(axis=0), 1 / 3, atol=0.01)
    np.testing.assert_allclose(surfaces.grid[0, 0], points.min(axis=0) - FAR, atol=1e-6)
    assert lab[weights[:, 0] > 0.8, 2].mean() > 20 > -20 > lab[weights[:, 1] > 0.8, 2].mean()  # red, blue
    ball = sphere((10, 120, 60), (0, 0, 0))
    inverted = dataclasses.replace(ball, faces=ball.faces[:, ::-1], corner_colors=ball.corner_colors[:, ::-1])
    both = surfaces_of([ball, inverted])
    np.testing.assert_allclose((both.table[:, :3] * both.table[:, 6:]).sum(axis=1), RADIUS, rtol=0.01)
