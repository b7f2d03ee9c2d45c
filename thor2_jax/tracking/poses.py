"""Camera poses: rigid motions from camera coordinates to coordinates that are fixed to the scene.

Clouds of one object from several known poses are merged in space before they are described.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.errors import InputError
from thor2_jax.frames.outliers import downsample_to_fit
from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL, PreparedInstance

__all__ = ["PosedInstance", "check_pose", "merge_views", "transform"]

PosedInstance = tuple[PreparedInstance, NDArray[np.float64]]
"""An instance and the pose [4, 4] of its camera, from camera to world coordinates."""

MAX_DEVIATION = 1e-3
"""Largest deviation of an entry from that of a rigid motion; files round to a few digits."""


def check_pose(pose: ArrayLike, argument: str = "pose") -> NDArray[np.float64]:
    """Return a camera pose [4, 4] float64.

    Args:
        pose: matrix from camera coordinates (OpenCV: x right, y down, z forward) to world coordinates, in metres.
        argument: its name in an error message.

    Raises:
        InputError: it is not a finite [4, 4] matrix, or not a rigid motion: a rotation and a translation.
    """
    try:
        matrix = np.array(pose, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(
            f"{argument} has shape {matrix.shape}; expected a matrix [4, 4] of finite numbers, from camera to world"
        )
    rotation = matrix[:3, :3]
    deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(matrix[3] - (0, 0, 0, 1)).max())
    if deviation > MAX_DEVIATION or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{argument} is not a rigid motion (deviation {deviation:.3g}, determinant {np.linalg.det(rotation):.3g}); "
            "expected a rotation and a translation in metres, from camera to world, last row 0 0 0 1"
        )
    return matrix


def transform(pose: NDArray[Any], points: NDArray[Any]) -> NDArray[np.float32]:
    """Return points [n, 3] moved by a pose [4, 4]."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3], np.float32)


def merge_views(views: Sequence[PosedInstance], sigma_s: float) -> PreparedInstance:
    """Return the last view with the points of all, in the coordinates of its camera, on the descriptors' voxel grid.

    What is occluded in one view may be visible in another one, so no point is on the occlusion boundary; likewise none
    is on the rim of a mask.

    Args:
        views: at least one view of the object.
        sigma_s: scaled units per metre, see `DescriptorConfig`.
    """
    last, pose = views[-1]
    to_last = np.linalg.inv(pose)
    points = np.concatenate([transform(to_last @ other, view.points) for view, other in views])
    colors = np.concatenate([view.colors for view, _ in views])
    points, colors = downsample_to_fit(points, colors, DESCRIPTOR_VOXEL / sigma_s)
    return dataclasses.replace(last, points=points, colors=colors, boundary=np.zeros(len(points), bool), rim=None)
