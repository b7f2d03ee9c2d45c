"""Surfaces of classes, with which recognition compares the points of instances (`thor2_jax.surfaces.evidence`)."""

import dataclasses
import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from thor2_jax.files import pack_arrays, unpack_arrays

__all__ = ["FAR", "GRID", "N_POINTS", "RADIUS", "SURFACES_FILE", "Surfaces", "rotations"]

SURFACES_FILE = "surfaces.safetensors"
"""File of the surfaces in a run directory and in a dataset of views."""

DIRECTIONS, TURNS = 27, 8
"""Numbers of view directions and of turns about each of them; R rotations = DIRECTIONS * TURNS."""

N_POINTS, GRID = 4096, 48
"""P, points of a surface, and cells of the grid along each axis."""

FAR = 0.02
"""Margin of the grid, and largest distance of a match in the first step of the refinement, metres."""

RADIUS = 0.01
"""Radius of the neighbourhoods for smoothed colours and for the roughness, metres."""


@functools.cache
def rotations() -> NDArray[np.float32]:
    """Return the rotations [R, 3, 3] from a class to a camera that looks along z."""
    k = np.arange(DIRECTIONS) + 0.5  # directions on a Fibonacci spiral
    z, angle = 1 - 2 * k / DIRECTIONS, np.pi * (1 + 5**0.5) * k
    towards = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    x = np.cross(towards, np.eye(3)[np.abs(towards).argmin(axis=1)])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    turn = np.arange(TURNS)[:, None] * 2 * np.pi / TURNS
    right = np.cos(turn) * x[:, None] + np.sin(turn) * np.cross(towards, x)[:, None]
    back = np.broadcast_to(towards[:, None], right.shape)
    return np.stack([right, np.cross(right, back), -back], axis=2).reshape(-1, 3, 3).astype(np.float32)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Surfaces:
    """The surfaces of C classes, metres, relative to the centres of their boxes.

    Attributes:
        table: [C, 9, P] float32, points, smoothed L*a*b* colours and outward unit normals.
        nearest: [C, GRID ** 3] int16, index of the point that is nearest to the centre of each cell.
        grid: [C, 2, 3] float32, lower corner of the grid and sides of a cell.
        boxes: [C, R, 3, 3] float32, lower corner, centroid and upper corner of the part that is visible in a rotation.
    """

    table: jax.Array
    nearest: jax.Array
    grid: jax.Array
    boxes: jax.Array

    @property
    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """The arrays on the host, by the names of their fields."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in dataclasses.fields(self)}

    @functools.cached_property
    def content(self) -> bytes:
        """The arrays as the bytes of a file."""
        return pack_arrays(self.arrays)

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[np.generic]]) -> "Surfaces":
        """Return the surfaces with these `arrays`."""
        return cls(**jax.device_put(dict(arrays)))

    @classmethod
    def of_content(cls, content: bytes) -> "Surfaces":
        """Return the surfaces with this `content`."""
        return cls.of_arrays(unpack_arrays(content)[0])

    @classmethod
    def empty(cls) -> "Surfaces":
        """Return a surface without extent, with which programs are compiled."""
        return cls(
            jnp.zeros((1, 9, N_POINTS), jnp.float32),
            jnp.zeros((1, GRID**3), jnp.int16),
            jnp.ones((1, 2, 3), jnp.float32),
            jnp.zeros((1, len(rotations()), 3, 3), jnp.float32),
        )

    def distances(self, index: int, pose: NDArray[np.float32], points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return how far points are from the surface of a class: at least the point-to-plane distance.

        Args:
            index: the class.
            pose: [3, 4], from `fit_poses` or `search_poses`.
            points: [n, 3], metres, relative to the camera.

        Returns:
            [n], metres; inf beyond the grid.
        """
        (low, cell), table = np.asarray(self.grid)[index], np.asarray(self.table)[index].T
        moved = points @ pose[:, :3].T + pose[:, 3]
        at = np.floor((moved - low) / cell)
        x, y, z = at.clip(0, GRID - 1).astype(int).T
        nearest = table[np.asarray(self.nearest)[index][(x * GRID + y) * GRID + z]]
        offset = moved - nearest[:, :3]
        plane = (offset * nearest[:, 6:]).sum(axis=1)
        distance = np.hypot(plane, np.linalg.norm(offset, axis=1) / 3)  # nearest points are samples of the surface
        return np.where(((at >= 0) & (at < GRID)).all(axis=1), distance, np.inf)
