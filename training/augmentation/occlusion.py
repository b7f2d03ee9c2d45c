"""Augmentation of occlusion: removes the part of a view behind the outline of a built-in object or a straight edge."""

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from training.augmentation.pixels import Range, pixel_width, without
from training.objects.builtin_objects import builtin_objects
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import DISTANCE, Camera, RenderedView, camera_pose

__all__ = ["Occlusion", "occluded"]

SILHOUETTE_PIXEL = 0.002
"""Side of a pixel of the silhouettes, metres."""

POSES = tuple((azimuth, polar) for azimuth in (0.4, 2.0) for polar in (0.8, 1.3))
"""Azimuth and polar angles of the silhouettes, radians: cameras that look down on a table."""

PLACES = 32
"""Candidate positions of a silhouette, on a line from outside the view to its centre."""

SAMPLE_PIXELS = 400
"""Approximate number of pixels that estimate the occluded share at each position."""

MAX_TRIES = 4
"""Silhouettes to try before a straight edge is used."""

SHARE_TOLERANCE = 0.05
"""Largest accepted difference between the drawn share and that of a silhouette."""


@dataclasses.dataclass(frozen=True)
class Occlusion:
    """Ranges of the occlusion; values are drawn once per view.

    Attributes:
        share: occluded share of the view's pixels.
        none: probability that a view is not occluded.
        straight: probability, for the others, that a straight edge (a large object) occludes it.
        nearer: scale of the silhouette; the occluding object is nearer to the camera by this factor.
    """

    share: Range = (0.05, 0.8)
    none: float = 0.2
    straight: float = 0.3
    nearer: Range = (1.0, 1.5)


def occluded(view: RenderedView, occlusion: Occlusion, rng: np.random.Generator) -> RenderedView:
    """Return the view without its occluded pixels; a straight edge replaces silhouettes that are too small."""
    pixels = np.flatnonzero(view.depth)
    n = len(pixels)
    if rng.random() < occlusion.none:
        return view
    share = rng.uniform(*occlusion.share)
    angle, width = rng.uniform(0, 2 * np.pi), pixel_width(view)
    c, s = width * np.cos(angle), width * np.sin(angle)
    row, column = (place - place.mean() for place in np.divmod(pixels, view.depth.shape[1]))
    # The occluding object moves along x.
    x, y = c * column + s * row, c * row - s * column
    for _ in range(0 if rng.random() < occlusion.straight else MAX_TRIES):
        hidden = _behind_silhouette(x, y, share, rng.uniform(*occlusion.nearer), rng)
        actual = hidden.mean()
        if abs(actual - share) <= SHARE_TOLERANCE and occlusion.share[0] <= actual <= occlusion.share[1]:
            break
    else:
        hidden = np.zeros(n, bool)
        hidden[np.argpartition(x, int(share * n))[: int(share * n)]] = True
    return without(view, pixels[hidden])


@functools.cache
def _silhouettes() -> tuple[NDArray[np.bool_], ...]:
    """Return silhouettes [h, w] of the built-in objects with an empty border; takes 0.2 s, once per process."""
    f = DISTANCE / SILHOUETTE_PIXEL
    camera = Camera.from_field_of_view(400, 400, float(np.degrees(2 * np.arctan(200 / f))))
    casters = [(RayCaster([mesh]), mesh.centre) for mesh in builtin_objects().values()]
    views = (render_view(caster, camera_pose(*pose, centre), camera) for caster, centre in casters for pose in POSES)
    return tuple(np.pad(view.depth > 0, 1) for view in views)


def _behind_silhouette(
    x: NDArray[np.float64], y: NDArray[np.float64], share: float, scale: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return which points (x [n], y [n], metres) a silhouette occludes that moves along x until it covers `share`."""
    bank = _silhouettes()
    silhouette = bank[rng.integers(len(bank))]
    pixel = SILHOUETTE_PIXEL * scale
    height, width = silhouette.shape
    sideways = rng.uniform(y.min(), y.max()) / 2
    places = np.linspace(x.min() - width / 2 * pixel, 0, PLACES)

    def hides(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points, relative to the silhouette's centre, it covers."""
        column = (x / pixel + width / 2).astype(np.intp).clip(0, width - 1)
        row = (y / pixel + height / 2).astype(np.intp).clip(0, height - 1)
        return silhouette[row, column]

    sample = slice(None, None, -(-len(x) // SAMPLE_PIXELS))
    shares = hides(x[sample] - places[:, None], y[sample] - sideways).mean(axis=1)
    return hides(x - places[np.argmin(np.abs(shares - share))], y - sideways)
