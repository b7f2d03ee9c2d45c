"""The clouds of the views of an object, as a gallery stores them: a few bytes per point."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance

__all__ = ["CompactClouds"]

STEP = 5e-5
"""Resolution of the coordinates, metres."""

MAX_DISTANCE = STEP * np.iinfo(np.int16).max
"""Largest distance of a point from the centre of its cloud along an axis, metres (1.6)."""


@dataclasses.dataclass(frozen=True, eq=False)
class CompactClouds:
    """The clouds of V views, one after the other.

    Attributes:
        points: [n, 3] int16, multiples of `STEP`, relative to `centre`.
        colors: [n, 3] uint8, sRGB.
        boundary: [n] bool, points on the occlusion boundary.
        counts: [V] int32, number of points of each view.
        centre: [V, 3] float32, metres, camera frame.
    """

    points: NDArray[np.int16]
    colors: NDArray[np.uint8]
    boundary: NDArray[np.bool_]
    counts: NDArray[np.int32]
    centre: NDArray[np.float32]

    @classmethod
    def of(cls, views: Sequence[PreparedInstance]) -> "CompactClouds":
        """Round prepared instances to compact clouds.

        Raises:
            InputError: an instance has no points or is larger than 2 `MAX_DISTANCE`.
        """
        points = [np.zeros((0, 3), np.int16)]
        centres = []
        for number, view in enumerate(views):
            if not len(view.points):
                raise InputError(f"views[{number}] has no points ({view.reason}); leave it out")
            centre = ((view.points.min(axis=0) + view.points.max(axis=0)) / 2).astype(np.float32)
            relative = view.points - centre
            if np.abs(relative).max() > MAX_DISTANCE:
                raise InputError(
                    f"views[{number}] is {2 * np.abs(relative).max():.2g} m long; expected at most "
                    f"{2 * MAX_DISTANCE:.2g} m: check its mask and the depth scale"
                )
            points.append(np.rint(relative / STEP).astype(np.int16))
            centres.append(centre)
        return cls(
            np.concatenate(points),
            np.concatenate([np.zeros((0, 3), np.uint8), *(view.colors for view in views)]),
            np.concatenate([np.zeros(0, bool), *(view.boundary for view in views)]),
            np.array([len(view.points) for view in views], np.int32),
            np.array(centres, np.float32).reshape(-1, 3),
        )

    def __len__(self) -> int:
        return len(self.counts)

    def __add__(self, other: "CompactClouds") -> "CompactClouds":
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return CompactClouds(*(np.concatenate(pair) for pair in pairs))

    def select(self, numbers: Sequence[int]) -> "CompactClouds":
        """Return the views with these numbers, in this order; they are not rounded again."""
        of_views = np.split(np.arange(len(self.points)), np.cumsum(self.counts)[:-1])
        rows = np.concatenate([np.zeros(0, int), *(of_views[number] for number in numbers)])
        points = self.points[rows], self.colors[rows], self.boundary[rows]
        return CompactClouds(*points, self.counts[numbers], self.centre[numbers])

    def views(self) -> Iterator[PreparedInstance]:
        """Yield each view as a prepared instance, in metres."""
        ends = np.cumsum(self.counts)
        for number, (count, end, centre) in enumerate(zip(self.counts, ends, self.centre, strict=True)):
            rows = slice(end - count, end)
            points = self.points[rows] * np.float32(STEP) + centre
            yield PreparedInstance(number, points, self.colors[rows], self.boundary[rows])
