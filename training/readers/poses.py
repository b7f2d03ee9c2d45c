"""Files of camera poses: one rigid motion for each frame of a sequence."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.tracking.poses import check_pose

__all__ = ["read_poses"]


def read_poses(path: Path, names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return the pose [4, 4] of each frame, from camera to world coordinates in metres.

    Args:
        path: JSON file with an object, frame name -> matrix, or with a list of matrices in the order of the frames.
        names: names of the frames.

    Raises:
        InputError: the file is invalid, a frame has no pose, there is another number of poses than of frames, or a
            pose is not a rigid motion. The message names the file.
        OSError: the file cannot be read.
    """
    try:
        stored = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        stored = None
    if not isinstance(stored, (dict, list)):
        raise InputError(f"poses: {path} is invalid; expected JSON: frame name -> [4, 4] matrix, or a list of matrices")
    if isinstance(stored, dict):
        missing = [name for name in names if name not in stored]
        if missing:
            raise InputError(f"poses: {path} has no pose of frame {missing[0]}; expected one for each frame")
        return [check_pose(stored[name], f"poses: {path}: the pose of frame {name}") for name in names]
    if len(stored) != len(names):
        raise InputError(f"poses: {path} has {len(stored)} poses for {len(names)} frames; expected one for each frame")
    return [
        check_pose(pose, f"poses: {path}: the pose of frame {name}") for name, pose in zip(names, stored, strict=True)
    ]
