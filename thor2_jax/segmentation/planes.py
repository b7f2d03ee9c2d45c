"""Dominant planes of a depth image: the table, and a floor or a wall behind it.

A plane is linear in inverse depth: 1 / z = a x + b y + c for the ray (x, y, 1) of a pixel. The error of a
structured-light or stereo camera is about constant in 1 / z. Planes are therefore found, refined and subtracted in
inverse depth. The refinement has second-order terms, which absorb the distortion of the depth sensor.
"""

import dataclasses
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, Intrinsics
from thor2_jax.segmentation.pixels import Mask, components, pixel_mask

__all__ = ["DepthImage", "Plane", "dominant_planes"]

MAX_PLANES = 8
HYPOTHESES = 150
SCORED_POINTS = 500
"""Number of points on which the hypotheses of a plane are scored."""

REFINED_POINTS = 3000
"""Number of points on which a plane is refined."""

LEAST_POINTS = 50
TOLERANCE = (0.003, 0.004)
"""Largest distance of an inlier: the first in metres, plus the second times the squared depth in metres."""

LEAST_SHARE = 0.05
"""Smallest fraction of the points that lie on a dominant plane."""

LEAST_SHARE_OF_LARGEST, LEAST_EXTENT_OF_LARGEST = 0.2, 0.15
LEAST_EXTENT = 0.23
"""Smallest extent, metres, across the longest direction of a plane after the largest; sides of boxes have less."""

LEAST_FILLING = 0.25
"""Smallest fraction of a plane's hull that its inliers fill; the tops of several objects at equal height fill less."""

PARALLEL, LARGEST_THING = 0.97, 0.15
"""Smallest cosine between the normals of a plane and of the tops of objects on it, and their largest height, metres."""

LARGEST_AREA = 0.15
"""Largest area of an object, square metres."""

TRAY_FILLING = 0.5
"""Smallest fraction of its hull that a tray fills; a pile whose tops are connected fills less."""


class DepthImage:
    """The usable part of a depth image.

    Attributes:
        z: [H, W] float32, metres; 0 where depth is missing or outside `MIN_DEPTH` to `MAX_DEPTH`.
        inverse: [H, W] float32, 1 / z; 0 where `z` is.
        valid: [H, W] bool, whether `z` is not 0.
        x: [W] float32, x of the pixels' rays (x, y, 1).
        y: [H] float32, y of the pixels' rays.
        pixel_size: width of a pixel at a depth of one metre, metres.
    """

    def __init__(self, depth_m: NDArray[np.float32], intrinsics: Intrinsics) -> None:
        """Prepare a depth image `depth_m` [H, W] in metres."""
        self.valid: Mask = (depth_m >= MIN_DEPTH) & (depth_m <= MAX_DEPTH)
        self.z = depth_m * self.valid
        self.inverse = np.divide(1, self.z, out=np.zeros_like(self.z), where=self.valid)
        height, width = self.z.shape
        self.x = ((np.arange(width) - intrinsics.cx) / intrinsics.fx).astype(np.float32)
        self.y = ((np.arange(height) - intrinsics.cy) / intrinsics.fy).astype(np.float32)
        self.pixel_size = 2 / (intrinsics.fx + intrinsics.fy)


@dataclasses.dataclass(frozen=True, eq=False)
class Plane:
    """A dominant plane.

    Attributes:
        coefficients: [6], a to f in 1 / z = a x + b y + c + d x^2 + e x y + f y^2.
        hull: [n, 2] int32, columns and rows of the convex hull of the inliers.
        share: fraction of the points that lie on the plane.
        distance: median depth of the inliers, metres.
    """

    coefficients: NDArray[np.float64]
    hull: NDArray[np.int32]
    share: float
    distance: float

    def heights(self, depth: DepthImage) -> NDArray[np.float32]:
        """Return the distance [H, W] of each point to the plane, metres, positive towards the camera; 0 if missing."""
        a, b, c, d, e, f = (float(value) for value in self.coefficients)
        x, y = depth.x, depth.y[:, None]
        inverse = (np.float32(e) * y + np.float32(a)) * x + d * x * x + (b * y + f * y * y + c)
        # The distance to the plane is z times the difference in 1 / z, divided by the length of (a, b, c).
        return np.asarray((depth.inverse - inverse) * depth.z * np.float32(1 / math.hypot(a, b, c)), np.float32)

    def region(self, shape: tuple[int, ...]) -> Mask:
        """Return which pixels [H, W] lie in the hull."""
        return pixel_mask(cv2.fillConvexPoly(np.zeros(shape, np.uint8), self.hull, 1))


class _Points:
    """Points of a grid of pixels, `step` pixels apart.

    The attributes are positions [N], terms [N, 6] for the coefficients, inverse depth [N] and tolerance [N].
    """

    def __init__(self, depth: DepthImage) -> None:
        height, width = depth.z.shape
        self.step = step = max(1, round(math.sqrt(height * width / REFINED_POINTS)))
        rows = np.arange((height - 1) % step // 2, height, step)
        columns = np.arange((width - 1) % step // 2, width, step)
        inverse = depth.inverse[np.ix_(rows, columns)].astype(np.float64)
        row, column = np.nonzero(inverse)
        self.rows, self.columns, self.inverse = rows[row], columns[column], inverse[row, column]
        x, y = depth.x[self.columns].astype(np.float64), depth.y[self.rows].astype(np.float64)
        self.terms = np.stack([x, y, np.ones_like(x), x * x, x * y, y * y], axis=1)
        self.tolerance = TOLERANCE[0] * self.inverse * self.inverse + TOLERANCE[1]


def dominant_planes(depth: DepthImage) -> list[Plane]:
    """Find up to `MAX_PLANES` planes by RANSAC; equal depth images have equal planes.

    Returns:
        The planes. The first one is the nearest plane of sufficient size, which is the likely support of the objects.
    """
    points = _Points(depth)
    total = len(points.inverse)
    left = np.arange(total)
    rng = np.random.default_rng(0)
    planes: list[Plane] = []
    for _ in range(MAX_PLANES):
        if len(left) < max(LEAST_POINTS, LEAST_SHARE * total):
            break
        hypothesis = _best_hypothesis(points, left, rng)
        if hypothesis is None:
            break
        inliers, coefficients = _refine(hypothesis, points, left)
        share = len(inliers) / total
        if share < (LEAST_SHARE if planes else LEAST_SHARE_OF_LARGEST):
            break
        pixels = np.stack([points.columns[inliers], points.rows[inliers]], axis=1).astype(np.int32)
        hull = np.asarray(cv2.convexHull(pixels), np.int32)[:, 0]
        filling = len(inliers) * points.step**2 / max(cv2.contourArea(hull), 1.0)
        extent, length = _extents(points, inliers)
        is_tray = filling > TRAY_FILLING and extent * length * _connected(points, inliers) > LARGEST_AREA
        tops = not is_tray and any(_is_just_above(plane.coefficients, coefficients) for plane in planes)
        if not tops and filling >= LEAST_FILLING and extent >= (LEAST_EXTENT if planes else LEAST_EXTENT_OF_LARGEST):
            planes.append(Plane(coefficients, hull, share, float(1 / np.median(points.inverse[inliers]))))
        left = np.setdiff1d(left, inliers)
    support = min(planes, key=lambda p: p.distance, default=None)
    return sorted(planes, key=lambda p: p is not support)


def _is_just_above(plane: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether `other` is parallel to a plane and slightly nearer to the camera, like tops of objects on it."""
    normals = np.stack([plane[:3], other[:3]])
    lengths = np.linalg.norm(normals, axis=1)
    parallel = normals[0] @ normals[1] > PARALLEL * lengths.prod()
    # The distance of a plane from the camera is 1 / |(a, b, c)|.
    return bool(parallel and 0 < 1 / lengths[0] - 1 / lengths[1] < LARGEST_THING)


def _best_hypothesis(points: _Points, left: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.float64] | None:
    """Return the plane [3] through three random points of `left` that has the most inliers."""
    triples = left[rng.integers(0, len(left), (HYPOTHESES, 3))]
    matrices = points.terms[triples, :3]
    usable = np.abs(np.linalg.det(matrices)) > 1e-4
    if not usable.any():
        return None
    planes = np.linalg.solve(matrices[usable], points.inverse[triples[usable]][..., None])[..., 0]
    scored = left[:: max(1, len(left) // SCORED_POINTS)]
    fields = points.terms[:, 0], points.terms[:, 1], points.inverse, points.tolerance
    x, y, inverse, tolerance = (values[scored].astype(np.float32) for values in fields)
    single = planes.astype(np.float32)
    # A matrix product would start threads.
    near = np.abs(single[:, :1] * x + single[:, 1:2] * y + single[:, 2:] - inverse) < tolerance
    return planes[int(np.count_nonzero(near, axis=1).argmax())]


def _refine(
    hypothesis: NDArray[np.float64], points: _Points, left: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return the inliers among `left` and their least-squares coefficients [6]."""
    coefficients = np.concatenate([hypothesis, np.zeros(3)])
    terms, inverse, tolerance = points.terms[left], points.inverse[left], points.tolerance[left]
    for n_terms in (3, 3, 3, 6, 6):
        near = np.abs(terms @ coefficients - inverse) < tolerance
        matrix = terms[near, :n_terms]
        fitted = np.linalg.solve(matrix.T @ matrix + 1e-9 * np.eye(n_terms), matrix.T @ inverse[near])
        coefficients = np.concatenate([fitted, np.zeros(6 - n_terms)])
    return left[near], coefficients


def _extents(points: _Points, inliers: NDArray[np.intp]) -> tuple[float, float]:
    """Return the width and the length, metres, of a uniform rectangle that spreads like the points."""
    positions = points.terms[inliers, :3] / points.inverse[inliers, None]
    _, width, length = np.sqrt(12 * np.linalg.eigvalsh(np.cov(positions.T)).clip(0))
    return float(width), float(length)


def _connected(points: _Points, inliers: NDArray[np.intp]) -> float:
    """Return the fraction of the points that lie in the largest connected part of the grid."""
    rows, columns = points.rows[inliers] // points.step, points.columns[inliers] // points.step
    grid = np.zeros((rows.max() + 1, columns.max() + 1), bool)
    grid[rows, columns] = True
    return float(components(grid)[1].max() / len(inliers))
