"""Several viewpoints of one scene: camera poses, merged clouds, and the choice of the next view.

A pose is a rigid motion from camera coordinates to coordinates that are fixed to the scene. Clouds of one object from
several known poses are merged in space before they are described.

The next view is the camera pose after which the name of an object is expected to be least uncertain. Training views of
the plausible classes predict what the camera would see. Each training view whose answer is similar to the current
answer may be the current view. The motion of the camera leads from it to another view of the same class, whose answer
is combined with the current one. The expected entropy is the mean over classes and views, weighted by probability.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.errors import InputError, as_array, decoding
from thor2_jax.files import as_path, parse_json, read_file
from thor2_jax.frames.outliers import downsample_to_fit
from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL, PreparedInstance

__all__ = [
    "NextView",
    "PosedInstance",
    "ViewTable",
    "check_pose",
    "merge_views",
    "next_view",
    "read_poses",
    "transform",
]

PosedInstance = tuple[PreparedInstance, NDArray[np.float64]]
"""An instance and the pose [4, 4] of its camera, from camera to world coordinates."""

MAX_DEVIATION = 1e-3
"""Largest deviation of a matrix entry from a rigid motion, since files contain only a few digits."""


def check_pose(pose: ArrayLike, argument: str = "pose") -> NDArray[np.float64]:
    """Return a camera pose [4, 4] float64.

    Args:
        pose: matrix from camera coordinates (OpenCV: x right, y down, z forward) to world coordinates, in metres.
        argument: name of the pose in an error message.

    Raises:
        InputError: the pose is not a finite [4, 4] matrix, or not a rigid motion (a rotation and a translation).
    """
    given = as_array(pose, argument, "a matrix [4, 4]")
    with decoding(f"{argument} is not numeric", "a matrix [4, 4], from camera to world"):
        matrix = given.astype(np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        fault = "NaN or infinity" if matrix.shape == (4, 4) else f"shape {matrix.shape}"
        raise InputError(f"{argument} has {fault}; expected a matrix [4, 4] of finite numbers, from camera to world")
    rotation = matrix[:3, :3]
    deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(matrix[3] - (0, 0, 0, 1)).max())
    if deviation > MAX_DEVIATION or np.linalg.det(rotation) < 0:
        raise InputError(
            f"{argument} is not a rigid motion (deviation {deviation:.3g}, determinant {np.linalg.det(rotation):.3g}); "
            "expected a rotation and a translation in metres, from camera to world, last row 0 0 0 1"
        )
    return matrix


def read_poses(path: Path, names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return the pose [4, 4] of each frame, from camera to world coordinates in metres.

    Args:
        path: JSON file with an object, frame name -> matrix, or with a list of matrices in the order of the frames.
        names: names of the frames.

    Raises:
        InputError: the file is invalid, a frame has no pose, the numbers of poses and frames differ, or a pose is not a
            rigid motion. The message names the file.
        OSError: the file cannot be read.
    """
    content = read_file(as_path(path, "poses"))
    with decoding(f"poses: {path} is invalid", "JSON: frame name -> [4, 4] matrix, or a list of matrices"):
        stored = parse_json(content)
        if not isinstance(stored, (dict, list)):
            raise TypeError(f"it holds a value of type {type(stored).__name__}")
    if isinstance(stored, dict):
        if missing := [name for name in names if name not in stored]:
            raise InputError(f"poses: {path} has no pose of frame {missing[0]}; expected one for each frame")
        stored = [stored[name] for name in names]
    if len(stored) != len(names):
        raise InputError(f"poses: their number in {path} is {len(stored)}; expected {len(names)}, one for each frame")
    return [
        check_pose(pose, f"poses: {path}: the pose of frame {name}") for name, pose in zip(names, stored, strict=True)
    ]


def transform(pose: NDArray[Any], points: NDArray[Any]) -> NDArray[np.float64]:
    """Return points [n, 3] moved by a pose [4, 4]; world coordinates of maps are too large for float32."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3], np.float64)


def merge_views(views: Sequence[PosedInstance], sigma_s: float) -> PreparedInstance:
    """Return the last view with the points of all views, in the last camera's coordinates, on the descriptors' grid.

    A part that is occluded in one view may be visible in another one. Therefore no point of the result is on the
    occlusion boundary or on the rim of a mask.

    Args:
        views: at least one view of the object.
        sigma_s: scaled units per metre, see `DescriptorConfig`.
    """
    last, pose = views[-1]
    to_last = np.linalg.inv(pose)
    points = np.concatenate([transform(to_last @ other, view.points) for view, other in views]).astype(np.float32)
    colors = np.concatenate([view.colors for view, _ in views])
    points, colors = downsample_to_fit(points, colors, DESCRIPTOR_VOXEL / sigma_s)
    return dataclasses.replace(last, points=points, colors=colors, boundary=np.zeros(len(points), bool), rim=None)


MIN_PROBABILITY = 0.02
"""Lowest probability of a plausible class."""

SHARPNESS = 5.0
"""A training view has the likelihood exp(-SHARPNESS D); D is the divergence of its answer from the current answer."""

TINY = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class ViewTable:
    """Training views of all classes, and the answers for them.

    Attributes:
        label: [V] class of each view.
        rotations: [V, 3, 3] rotation of each view's camera, from camera to object axes; cameras look at the object.
        probabilities: [V, C] fused class probabilities of each view.
    """

    label: NDArray[np.intp]
    rotations: NDArray[np.float64]
    probabilities: NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class NextView:
    """The best of several camera poses.

    Attributes:
        index: index of the best candidate.
        expected: [n] expected entropy after each candidate, nats.
        entropy: entropy of the current answer, nats.
    """

    index: int
    expected: NDArray[np.float64]
    entropy: float


def next_view(
    probabilities: ArrayLike, centre: ArrayLike, pose: ArrayLike, candidates: Sequence[ArrayLike], table: ViewTable
) -> NextView:
    """Choose the camera pose from which an object with an uncertain name should be seen next.

    Args:
        probabilities: [C] the object's fused class probabilities.
        centre: [3] the middle of the object's cloud, world coordinates in metres.
        pose: [4, 4] pose of the current camera, from camera to world.
        candidates: poses [4, 4] that the camera can reach and from which it sees the object.
        table: training views.

    Raises:
        InputError: there is no candidate, a pose is not a rigid motion, a number is not finite, or the table has other
            classes.
    """
    p, middle = np.asarray(probabilities, np.float64), np.asarray(centre, np.float64)
    if not len(candidates):
        raise InputError("candidates is empty; expected at least one camera pose")
    for name, values, shape in (("probabilities", p, table.probabilities.shape[1:]), ("centre", middle, (3,))):
        if values.shape != shape or not np.isfinite(values).all():
            raise InputError(f"{name} is {values.tolist()}; expected {list(shape)} finite numbers")
    now = check_pose(pose)
    poses = [check_pose(each, f"candidates[{k}]") for k, each in enumerate(candidates)]
    p = np.maximum(p, TINY) / np.maximum(p, TINY).sum()
    # Directions from the object to the candidates, in the axes of the current camera.
    towards = (np.array([each[:3, 3] for each in poses]) - middle) @ now[:3, :3]
    expected, total = np.zeros(len(poses)), 0.0
    for index in np.flatnonzero(p >= MIN_PROBABILITY):
        views = np.flatnonzero(table.label == index)
        if not len(views):
            continue
        answers = np.maximum(table.probabilities[views], TINY)
        answers /= answers.sum(axis=1, keepdims=True)
        likely = np.exp(-SHARPNESS * (p * np.log(p / answers)).sum(axis=1))
        rotations = table.rotations[views]
        # A camera looks along its z axis, so the direction from the object to the camera is -z.
        seen_from = np.einsum("vij,nj->vni", rotations, towards)
        nearest = (seen_from @ -rotations[:, :, 2].T).argmax(axis=2)  # [v, n]
        posterior = p * answers[nearest]
        posterior /= posterior.sum(axis=2, keepdims=True)
        entropies = -(posterior * np.log(posterior)).sum(axis=2)
        expected += p[index] * (likely @ entropies) / likely.sum()
        total += p[index]
    entropy = float(-(p * np.log(p)).sum())
    expected = np.full(len(poses), entropy) if total == 0 else expected / total
    return NextView(int(expected.argmin()), expected, entropy)
