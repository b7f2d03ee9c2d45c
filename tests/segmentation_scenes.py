"""Synthetic frames with known instances: boxes, coloured strips and meshes on a table."""

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from benchmarks.segmentation import overlaps
from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from training.rendering.camera import Hits, RayCaster, pixel_rays

HEIGHT, WIDTH = 240, 320
CAMERA = Intrinsics(290.0, 290.0, 159.5, 119.5)
TABLE = (150, 120, 90)


@dataclasses.dataclass(frozen=True)
class Box:
    """A box on the plane z = 0 of a table: centre and half extents, metres, its height and its colour."""

    x: float
    y: float
    half: tuple[float, float]
    height: float
    color: tuple[int, int, int]
    bottom: float = 0.0


APART = [
    Box(-0.2, 0.05, (0.04, 0.06), 0.12, (190, 30, 40)),
    Box(0.0, -0.1, (0.05, 0.03), 0.06, (30, 60, 190)),
    Box(0.2, 0.1, (0.03, 0.03), 0.15, (30, 150, 60)),
]
"""Three boxes apart from one another."""


def camera_pose(tilt: float = 40.0, turn: float = 0.0, roll: float = 0.0) -> Rotation:
    """Return the rotation table <- camera of a camera that looks at the origin, `tilt` degrees from straight down."""
    down = Rotation.from_euler("x", 180, degrees=True)
    return Rotation.from_euler("zxz", [turn, tilt, roll], degrees=True) * down


def surface(mesh: trimesh.Trimesh, colors: ArrayLike) -> Any:
    """Return what a ray caster needs of a mesh, with a colour for all faces or for each."""
    of_faces = np.broadcast_to(np.asarray(colors, np.uint8), (len(mesh.faces), 3))
    return SimpleNamespace(vertices=mesh.vertices, faces=mesh.faces, colors_at=lambda face, _: of_faces[face])


def cuboid(low: ArrayLike, high: ArrayLike, color: ArrayLike) -> Any:
    """Return the surface of a box between two corners."""
    box = trimesh.creation.box(np.subtract(high, low))
    box.apply_translation(np.add(low, high) / 2)
    return surface(box, color)


def cast(surfaces: Sequence[Any], rotation: Rotation, distance: float, camera: Intrinsics, size: Sequence[int]) -> Hits:
    """Return what the pixels of a camera see that looks at the origin."""
    pose = np.eye(4)
    pose[:3, :3] = rotation.as_matrix()
    return RayCaster(surfaces).cast(-distance * pose[:3, 2], pixel_rays(camera, *size, pose))


TABLE_TOP = cuboid((-20, -20, -1), (20, 20, 0), TABLE)


def render(
    boxes: Sequence[Box],
    tilt: float = 40.0,
    turn: float = 0.0,
    roll: float = 0.0,
    distance: float = 0.9,
    noise: float = 0.0015,
    size: tuple[int, int] = (HEIGHT, WIDTH),
    plane: bool = True,
) -> RGBDFrame:
    """Return a frame of boxes on a table; their labels are 1, 2, ... Boxes of height 0 are flat strips.

    Noise is that of inverse depth, per metre.
    """
    scale = size[1] / WIDTH
    camera = Intrinsics(*(v * scale for v in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)))
    surfaces = [TABLE_TOP] * plane
    for box in boxes:
        low = np.array([box.x - box.half[0], box.y - box.half[1], box.bottom])
        surfaces.append(cuboid(low, low + [2 * box.half[0], 2 * box.half[1], max(box.height, 1e-5)], box.color))
    hits = cast(surfaces, camera_pose(tilt, turn, roll), distance, camera, size)
    is_hit = hits.mesh >= 0
    rng = np.random.default_rng(0)
    colors = np.where(is_hit[:, None], hits.color, TABLE) + rng.normal(0, 2, hits.color.shape)
    inverse = 1 / np.where(is_hit, hits.distance, np.inf).astype(float) + rng.normal(0, noise, is_hit.shape)
    metres = np.where(is_hit & (inverse > 0), 1 / inverse, 0)
    return RGBDFrame(
        np.clip(colors, 0, 255).astype(np.uint8).reshape(*size, 3),
        np.rint(np.clip(metres, 0, 60) * 1000).astype(np.uint16).reshape(size),
        (hits.mesh + (not plane)).clip(0).reshape(size),
        camera,
    )


def best_overlaps(labels: NDArray[np.int32], truth: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return for each true instance 1, 2, ... the largest intersection over union with a label."""
    common = overlaps(labels, truth)
    union = common.sum(axis=1)[:, None] + common.sum(axis=0) - common
    return np.asarray((common / union)[1:, 1:].max(axis=1, initial=0))
