"""Augmented copies of enrolled views, made from their clouds without rendering: light, sensor noise and cut masks.

Views, whether a few frames or renderings of a mesh, show little of how another camera sees the object. The copies are
drawn from the cloud itself, so that each copy of a view is the same in every embedding.
"""

import math
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from thor2_jax.adaptation.color_transform import LUMA
from thor2_jax.frames.instance_clouds import MIN_POINTS
from thor2_jax.frames.prepared_instance import PreparedInstance

__all__ = ["augmented_copies", "augmented_view"]

MAX_COPIES = 8
"""Copies of all views from frames together."""

MESH_COPIES = 1
"""Copies of each view from a mesh."""

CAST, MESH_CAST = 0.06, 0.2
"""Largest deviation from 1 of the factor of each colour channel, for objects from frames and for those with a mesh."""


def augmented_copies(views: Sequence[PreparedInstance], source: str) -> list[PreparedInstance]:
    """Return copies of the views of one object.

    Args:
        views: the views.
        source: "mesh" or "mesh and frames" for `MESH_COPIES` of each view, with colour casts up to `MESH_CAST`; with
            "frames", about `MAX_COPIES` in all, with casts up to `CAST`, and none for more than that many views.
    """
    of_mesh = source.startswith("mesh")
    copies, cast = (MESH_COPIES, MESH_CAST) if of_mesh else (MAX_COPIES // max(len(views), 1), CAST)
    return [augmented_view(view, copy, cast) for view in views for copy in range(copies)]


def augmented_view(view: PreparedInstance, copy: int, cast: float = CAST) -> PreparedInstance:
    """Return an augmented copy of a view; it is determined by the arguments.

    Args:
        view: a view with at least one point.
        copy: number of the copy.
        cast: largest deviation from 1 of the factor of each colour channel.
    """
    rng = np.random.default_rng([zlib.crc32(np.ascontiguousarray(view.colors).tobytes()), len(view.points), copy])
    points, keep = _sensed(view.points, rng), ~_cut(view.points, rng)
    if keep.sum() < MIN_POINTS:
        keep[:] = True
    colors = _relit(view.colors, cast, rng)
    return PreparedInstance(view.label, points[keep], colors[keep], view.boundary[keep], view.occluded)


def _relit(colors: NDArray[np.uint8], cast: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the colours under another light: gamma, gain, colour cast, saturation, stray light and noise."""
    gamma, gain, saturation = rng.uniform(0.8, 1.25), rng.uniform(0.75, 1.25), rng.uniform(0.75, 1.3)
    channels, veil = rng.uniform(1 - cast, 1 + cast, 3), rng.uniform(0, 0.05)
    values = (colors / np.float32(255)) ** np.float32(gamma) * np.float32(gain) * channels.astype(np.float32)
    grey = (values @ LUMA)[:, None]
    values = (grey + np.float32(saturation) * (values - grey)) * np.float32(1 - veil) + np.float32(veil)
    values += np.float32(rng.uniform(0, 0.01)) * rng.standard_normal(values.shape, np.float32)
    return np.rint(255 * values).clip(0, 255).astype(np.uint8)


def _sensed(points: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the points with noise along their rays, with the deviation of a depth camera at half of its noise."""
    deviation = rng.uniform(0, 0.5) * (0.0012 + 0.0019 * (points[:, 2:] - 0.4) ** 2)
    noise = deviation * rng.standard_normal((len(points), 1))
    return (points * (1 + noise / np.maximum(points[:, 2:], 0.1))).astype(np.float32)


def _cut(points: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return the points that a mask misses on one side of the silhouette, at most an eighth of them."""
    angle = rng.uniform(0, 2 * np.pi)
    rays = points[:, :2] / np.maximum(points[:, 2:], 0.1)
    along = rays @ np.array([np.cos(angle), np.sin(angle)])
    rank = math.ceil(rng.uniform(0, 0.125) * (len(along) - 1))
    return np.asarray(along < np.partition(along, rank)[rank])
