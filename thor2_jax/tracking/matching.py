"""Matching of two frames: the clouds that overlap most in space show the same object.

The overlap of two clouds is the share of the smaller one's voxels that the other one also occupies, averaged over the
voxel sizes `VOXELS`. Small voxels distinguish neighbouring objects; large ones allow for motion between the frames.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["MIN_OVERLAP", "OccupiedVoxels", "match", "occupied_voxels", "overlap"]

VOXELS = (0.01, 0.02, 0.04)
"""Voxel sides, metres."""

MIN_OVERLAP = 0.2
"""Least overlap of two clouds of one object."""

_OFFSET = 2**20
"""Half the number of voxels along each axis that get a number of their own."""

OccupiedVoxels = tuple[NDArray[np.int64], ...]
"""Numbers of the voxels that a cloud occupies, in increasing order, for each of `VOXELS`."""


def occupied_voxels(points: NDArray[np.floating]) -> OccupiedVoxels:
    """Return the voxels that points [n, 3] in metres occupy, for each of `VOXELS`."""
    numbers = []
    for size in VOXELS:
        x, y, z = np.floor(points / size).astype(np.int64).T + _OFFSET
        numbers.append(np.unique((x * 2 * _OFFSET + y) * 2 * _OFFSET + z))
    return tuple(numbers)


def overlap(first: OccupiedVoxels, second: OccupiedVoxels) -> float:
    """Return the overlap of two clouds, from 0 to 1."""
    shares = [
        len(np.intersect1d(a, b, assume_unique=True)) / max(min(len(a), len(b)), 1)
        for a, b in zip(first, second, strict=True)
    ]
    return float(np.mean(shares))


def match(first: Sequence[OccupiedVoxels], second: Sequence[OccupiedVoxels]) -> list[tuple[int, int]]:
    """Return pairs of indices, one of each sequence, with the largest total overlap; each index occurs at most once.

    Pairs with an overlap below `MIN_OVERLAP` are left out.
    """
    from scipy.optimize import linear_sum_assignment  # takes .1 s to import, and one frame needs no matches

    overlaps = np.array([[overlap(a, b) for b in second] for a in first]).reshape(len(first), len(second))
    overlaps[overlaps < MIN_OVERLAP] = 0
    rows, columns = linear_sum_assignment(overlaps, maximize=True)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if overlaps[i, j] > 0]
