"""Synthetic frames with known instances: boxes, balls and coloured strips on a plane, by intersecting rays."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thor2_jax.frames.frames import Intrinsics, RGBDFrame

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


def camera_pose(tilt: float = 40.0, turn: float = 0.0, roll: float = 0.0) -> Rotation:
    """Return the rotation table <- camera of a camera that looks at the origin, `tilt` degrees from straight down."""
    down = Rotation.from_euler("x", 180, degrees=True)
    return Rotation.from_euler("zxz", [turn, tilt, roll], degrees=True) * down


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
    rotation = camera_pose(tilt, turn, roll)
    scale = size[1] / WIDTH
    camera = Intrinsics(*(v * scale for v in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)))
    row, column = np.mgrid[0 : size[0], 0 : size[1]]
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(size)], axis=-1)
    directions = rays.reshape(-1, 3) @ rotation.as_matrix().T
    origin = -distance * rotation.apply([0, 0, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -origin[2] / directions[:, 2]
        depth[~(depth > 0)] = np.inf
        labels = np.zeros(len(depth), np.int32)
        at = origin + depth[:, None] * directions
        if not plane:
            depth[:] = np.inf
        for number, box in enumerate(boxes, start=1):
            low = np.array([box.x - box.half[0], box.y - box.half[1], box.bottom])
            high = np.array([box.x + box.half[0], box.y + box.half[1], box.bottom + box.height])
            if box.height == 0:
                inside = (at[:, :2] > low[:2]).all(axis=1) & (at[:, :2] < high[:2]).all(axis=1) & (labels == 0)
                labels[inside] = number
                continue
            first, second = (low - origin) / directions, (high - origin) / directions
            near, far = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
            hit = (near < far) & (near > 0) & (near < depth)
            depth[hit], labels[hit] = near[hit], number
    colors = np.array([TABLE, *(box.color for box in boxes)], float)[labels]
    rng = np.random.default_rng(0)
    colors += rng.normal(0, 2, colors.shape)
    inverse = 1 / depth + rng.normal(0, noise, depth.shape)
    metres = np.where(np.isfinite(depth) & (inverse > 0), 1 / inverse, 0)
    return RGBDFrame(
        np.clip(colors, 0, 255).astype(np.uint8).reshape(*size, 3),
        np.rint(np.clip(metres, 0, 60) * 1000).astype(np.uint16).reshape(size),
        labels.reshape(size),
        camera,
    )


def best_overlaps(labels: NDArray[np.int32], truth: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return for each true instance 1, 2, ... the largest intersection over union with a label."""
    return np.array(
        [
            max(
                ((labels == k) & (truth == number)).sum() / ((labels == k) | (truth == number)).sum()
                for k in [*np.unique(labels[labels > 0]), -1]
            )
            for number in range(1, truth.max() + 1)
        ]
    )
