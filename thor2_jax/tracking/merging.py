"""Clouds of one object from several known camera poses, merged in space before they are described."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL, PreparedInstance
from thor2_jax.frames.voxel_grid import downsample_to_fit
from thor2_jax.tracking.poses import transform

__all__ = ["PosedInstance", "merge_views"]

PosedInstance = tuple[PreparedInstance, NDArray[np.float64]]
"""An instance and the pose [4, 4] of its camera, from camera to world coordinates."""


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
