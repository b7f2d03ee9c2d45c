"""Surfaces of meshes, with which recognition compares the points of instances (`thor2_jax.surfaces.evidence`)."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from thor2_jax.descriptor.slicing import to_lab
from thor2_jax.surfaces.surfaces import FAR, GRID, N_POINTS, RADIUS, Surfaces, rotations
from training.objects.mesh import TexturedMesh

__all__ = ["surfaces_of"]

Array = NDArray[np.float64]


def surfaces_of(meshes: Iterable[TexturedMesh]) -> Surfaces:
    """Return the surfaces of meshes, which are read one at a time; the normals of a mesh may all point inwards."""
    with jax.default_device(jax.local_devices(backend="cpu")[0]):  # accelerators round differently
        return Surfaces(*map(jnp.asarray, map(np.stack, zip(*map(_surface, meshes), strict=True))))


def _surface(mesh: TexturedMesh) -> tuple[NDArray[np.generic], ...]:
    """Return the fields of `Surfaces` for one class, without the first axis."""
    points, colors, normals = _sample_points(mesh)
    tree, lab = KDTree(points), np.asarray(to_lab(jnp.asarray(colors, jnp.float32)))
    smoothed = np.stack([lab[near].mean(axis=0) for near in tree.query_ball_point(points, RADIUS)])
    low, high = points.min(axis=0) - FAR, points.max(axis=0) + FAR
    grid = np.stack([low, (high - low) / GRID])
    centres = np.stack(np.meshgrid(*[np.arange(GRID) + 0.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * grid[1] + low
    seen = points @ rotations().mT
    facing = np.maximum(-normals @ rotations()[:, 2].T, 0)  # [P, R]; occlusion by the class itself is neglected
    mean = np.einsum("pr,rpk->rk", facing / np.maximum(facing.sum(axis=0), 1e-6), seen)
    boxes = np.stack([seen.min(axis=1), mean, seen.max(axis=1)], axis=1)
    table, nearest = np.concatenate([points, smoothed, normals], axis=1).T, tree.query(centres)[1]
    return table.astype(np.float32), nearest.astype(np.int16), grid.astype(np.float32), boxes.astype(np.float32)


def _sample_points(mesh: TexturedMesh) -> tuple[Array, Array, Array]:
    """Return positions, sRGB colours in [0, 1] and outward normals [P, 3] of points sampled uniformly by area."""
    rng, corners = np.random.default_rng(0), mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    place = (np.arange(N_POINTS) + rng.random(N_POINTS)) / N_POINTS * area.sum()
    face = area.cumsum().searchsorted(place).clip(max=len(area) - 1)
    second, third = rng.random((2, N_POINTS, 1))
    second, third = np.where(second + third > 1, (1 - second, 1 - third), (second, third))
    a, b, c = np.moveaxis(corners[face], 1, 0)
    points = a + second * (b - a) + third * (c - a) - mesh.centre
    colors = mesh.colors_at(face, np.concatenate([second, third], axis=1))
    normals = across[face] / area[face, None]
    return points, colors / 255, normals * np.copysign(1, (points * normals).sum())
