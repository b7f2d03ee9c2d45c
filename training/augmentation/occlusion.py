"""Another object in front: part of a view is hidden, along the outline of one of the built-in objects or an edge."""

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from training.augmentation.pixels import pixel_width, without
from training.augmentation.settings import Range, check_fields
from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import Camera, RenderedView
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import DISTANCE, camera_pose

__all__ = ["Occlusion", "occluded"]

SILHOUETTE_PIXEL = 0.002
"""Metres: side of a silhouette's pixel."""

POSES = tuple((azimuth, polar) for azimuth in (0.4, 2.0) for polar in (0.8, 1.3))
"""Azimuth and polar angle, radians, from which silhouettes are taken: as a camera looks down on a table."""

PLACES = 32
"""Places of the silhouette that are tried, on a line from outside the view to its middle."""

SAMPLE_PIXELS = 400
"""Pixels of the view, about, that tell how much is hidden at each place."""

MAX_TRIES = 4
"""Silhouettes that are tried before a straight edge."""

SHARE_TOLERANCE = 0.05
"""How far from the share drawn a silhouette's may be."""


@dataclasses.dataclass(frozen=True)
class Occlusion:
    """What hides a view, drawn once a view.

    Attributes:
        share: of the view's pixels that are hidden.
        none: share of views that nothing hides.
        straight: share of the others that a straight edge hides, as of something large.
        nearer: factor of the silhouette's size: the other object is that much nearer to the camera.

    Raises:
        InputError: a value outside its limits.
    """

    share: Range = (0.05, 0.6)
    none: float = 0.3
    straight: float = 0.3
    nearer: Range = (1.0, 1.5)

    def __post_init__(self) -> None:
        check_fields(self, share=(0, 0.95), none=(0, 1), straight=(0, 1), nearer=(1, 10))


def occluded(view: RenderedView, occlusion: Occlusion, rng: np.random.Generator) -> RenderedView:
    """The view without what is hidden. Where silhouettes are too small for the share drawn, a straight edge does."""
    pixels = np.flatnonzero(view.depth)
    n = len(pixels)
    if n == 0 or rng.random() < occlusion.none:
        return view
    share = rng.uniform(*occlusion.share)
    angle, width = rng.uniform(0, 2 * np.pi), pixel_width(view)
    c, s = width * np.cos(angle), width * np.sin(angle)
    row, column = (place - place.mean() for place in np.divmod(pixels, view.depth.shape[1]))
    # The other object comes along x.
    x, y = c * column + s * row, c * row - s * column
    for _ in range(0 if rng.random() < occlusion.straight else MAX_TRIES):
        hidden = _behind_silhouette(x, y, share, rng.uniform(*occlusion.nearer), rng)
        found = hidden.mean()
        if abs(found - share) <= SHARE_TOLERANCE and occlusion.share[0] <= found <= occlusion.share[1]:
            break
    else:
        hidden = np.zeros(n, bool)
        hidden[np.argpartition(x, int(share * n))[: int(share * n)]] = True
    return without(view, pixels[hidden])


@functools.cache
def _silhouettes() -> tuple[NDArray[np.bool_], ...]:
    """Outlines [h, w] of the built-in objects, with nothing on the border; 0.2 s, once a process."""
    f = DISTANCE / SILHOUETTE_PIXEL
    camera = Camera.from_field_of_view(400, 400, float(np.degrees(2 * np.arctan(200 / f))))
    found = []
    for mesh in builtin_objects().values():
        caster = RayCaster([mesh])
        found += [np.pad(render_view(caster, camera_pose(*pose, mesh.centre), camera).depth > 0, 1) for pose in POSES]
    return tuple(found)


def _behind_silhouette(
    x: NDArray[np.float64], y: NDArray[np.float64], share: float, scale: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Which points (x [n] and y [n], metres) a silhouette hides that comes along x until it hides about `share`."""
    bank = _silhouettes()
    silhouette = bank[rng.integers(len(bank))]
    pixel = SILHOUETTE_PIXEL * scale
    height, width = silhouette.shape
    sideways = rng.uniform(y.min(), y.max()) / 2
    places = np.linspace(x.min() - width / 2 * pixel, 0, PLACES)

    def hides(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        """For points relative to the silhouette's middle."""
        column = (x / pixel + width / 2).astype(np.intp).clip(0, width - 1)
        row = (y / pixel + height / 2).astype(np.intp).clip(0, height - 1)
        return silhouette[row, column]

    sample = slice(None, None, -(-len(x) // SAMPLE_PIXELS))
    shares = hides(x[sample] - places[:, None], y[sample] - sideways).mean(axis=1)
    return hides(x - places[np.argmin(np.abs(shares - share))], y - sideways)
