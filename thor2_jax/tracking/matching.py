"""Matching of the clouds of two frames, which tells which instances are the same object.

Clouds are matched so that their total overlap is largest. The overlap is the number of voxels that both clouds occupy,
divided by the geometric mean of their numbers of voxels, averaged over the voxel sizes `VOXELS`. An object that is
largely occluded is still matched; a small object near the place of a large one is not. Small voxels distinguish
neighbouring objects; large voxels allow for small motions of objects and for other views of their surfaces.

A camera that moves, or turns a little, moves all objects alike. The motion that most objects have in common is found
from the means of the clouds, and undone if that increases the overlap.
"""

import functools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

__all__ = ["match", "moved"]

VOXELS = (0.01, 0.02, 0.04)
"""Voxel sides, metres."""

MIN_OVERLAP = 0.25
"""Smallest overlap of two clouds of one object. With 0.2, twice as many objects continue the track of another one."""

SIMILAR_SIZE = 0.6
"""Smallest ratio of the numbers of points of two clouds whose means suggest a motion of the camera."""

SAME_MOTION, FARTHEST = 0.015, 0.15
"""Largest difference of two motions that count as equal, and largest motion between two frames, metres."""

_AXIS = 2**21
"""Number of voxels along each axis that have distinct numbers."""

Clouds = Sequence[NDArray[np.floating]]
"""Points [n, 3] of each instance of a frame, metres."""


def overlaps(first: Clouds, second: Clouds) -> NDArray[np.float64]:
    """Return the overlap, from 0 to 1, of each cloud of `first` with each cloud of `second`, [n, m]."""
    shares = []
    for size in VOXELS:
        places = (np.floor(cloud / size).astype(np.int64).T for cloud in (*first, *second))
        occupied = [np.unique((x * _AXIS + y) * _AXIS + z) for x, y, z in places]
        counts = np.array([len(each) for each in occupied])
        ends = np.concatenate([[0], np.cumsum(counts)])
        voxel = np.unique(np.concatenate([np.zeros(0, int), *occupied]), return_inverse=True)[1]
        is_occupied = csr_array((np.ones(len(voxel)), voxel, ends), (len(occupied), len(voxel) + 1))
        common = is_occupied[: len(first)] @ is_occupied[len(first) :].T
        shares.append(common.toarray() / np.sqrt(np.outer(counts[: len(first)], counts[len(first) :])))
    return np.asarray(np.mean(shares, axis=0))


def common_motion(before: Clouds, now: Clouds) -> NDArray[np.float64]:
    """Return the translation [3], metres, that brings most of the clouds [n, 3] `now` to clouds `before`.

    Each pair of clouds of similar size suggests the difference of its means, and a camera at rest suggests zero. The
    suggestion of most objects is taken, the smallest one of several; at least two objects must agree on a motion.
    """
    means = [np.array([cloud.mean(axis=0) for cloud in clouds]).reshape(-1, 3) for clouds in (before, now)]
    sizes = [np.array([len(cloud) for cloud in clouds]) for clouds in (before, now)]
    motions = means[0][:, None] - means[1]
    length = np.linalg.norm(motions, axis=2)
    similar = np.minimum.outer(*sizes) >= SIMILAR_SIZE * np.maximum.outer(*sizes)
    pairs = np.argwhere(similar & (length <= FARTHEST))
    pairs = np.pad(pairs[np.argsort(length[*pairs.T])], ((1, 0), (0, 0)), constant_values=-1)
    suggested = np.concatenate([np.zeros((1, 3)), motions[*pairs[1:].T]])
    agreeing = functools.partial(KDTree(suggested).query_ball_point, r=SAME_MOTION, return_sorted=True)

    def votes(number: int) -> int:
        return min(len(np.unique(objects)) for objects in pairs[agreeing(suggested[number])].T)

    # In a crowd, the lists of all agreeing suggestions take gigabytes; their lengths show which can have most votes.
    most = agreeing(suggested, return_length=True)
    best = max(np.flatnonzero(most >= votes(int(most.argmax()))).tolist(), key=votes)
    return suggested[agreeing(suggested[best])].mean(axis=0) if best else np.zeros(3)


def moved(cloud: NDArray[np.floating], motion: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return a cloud [n, 3] of the same type that is translated by a motion [3]."""
    return cloud + motion.astype(cloud.dtype)  # another type would round to other voxels


def match(before: Clouds, now: Clouds, is_moving: bool = True) -> tuple[list[tuple[int, int]], NDArray[np.float64]]:
    """Match the clouds of two frames so that their total overlap is largest.

    Args:
        before: clouds of the earlier frame.
        now: clouds of the later frame.
        is_moving: whether a motion may be common to the clouds; False in world coordinates.

    Returns:
        Pairs of indices into both sequences, each index at most once and without overlaps below `MIN_OVERLAP`; and the
        translation [3] of the clouds `now`: zero or, if the camera is moving, `common_motion`, whichever gives the
        larger overlap.
    """
    from scipy.optimize import linear_sum_assignment  # takes 0.1 s to import, and one frame needs no matches

    results = []
    common = common_motion(before, now) if is_moving else np.zeros(3)
    for motion in dict.fromkeys(((0.0, 0.0, 0.0), tuple(common.tolist()))):
        shares = overlaps(before, [moved(cloud, np.array(motion)) for cloud in now])
        shares[shares < MIN_OVERLAP] = 0
        rows, columns = linear_sum_assignment(shares, maximize=True)
        pairs = [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if shares[i, j] > 0]
        results.append((shares[rows, columns].sum(), pairs, np.array(motion)))
    return max(results, key=lambda each: each[0])[1:]
