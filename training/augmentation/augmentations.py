"""Augmentations of training views. They go beyond the paper, and each can be switched off.

    augmentations = Augmentations(illumination=Illumination(), occlusion=Occlusion())
    copy = augment(caster.render(pose), augmentations, np.random.default_rng(0))

An augmented copy has the pose of its view. Illumination and registration change its colours only; segmentation adds or
removes pixels along the outline; the base removes the lowest pixels; occlusion removes pixels behind another object;
the sensor perturbs or removes depth. Where pixels are added or removed, colour and depth change together. The view as
rendered is always kept as copy 0.

The augmentations of light, registration and noise are in `sensing`. Those of the mask are here:

- A view is occluded by the outline of a built-in object or a straight edge.
- A mask is too small or too large by some pixels, so that points are missing or from the background. The background is
  a plane: the table, or a wall behind. Outside the outline, only background with a depth close to the object's is
  added. Outlier removal in recognition discards the rest, a strip a few millimetres wide, anyway.
- Segmenters that remove the table plane also remove the base of an object, its lowest part.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, maximum_filter

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics
from thor2_jax.frames.outliers import PIECE_CELL, flying_pixels
from training.augmentation import sensing
from training.augmentation.sensing import FRAME_PIXEL, Range
from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import DISTANCE, TRAINING_CAMERA, Camera, RayCaster, RenderedView, camera_pose

__all__ = ["KINDS", "Augmentations", "augment"]

SILHOUETTE_PIXEL = 0.002
"""Side of a pixel of the silhouettes, metres."""

POSES = tuple((azimuth, polar) for azimuth in (0.4, 2.0) for polar in (0.8, 1.3))
"""Azimuth and polar angles from which the silhouettes are rendered, radians, as by cameras above a table."""

PLACES = 32
"""Number of candidate positions of a silhouette, on a line from outside the view to its centre."""

SAMPLE_PIXELS = 400
"""Approximate number of pixels from which the occluded fraction at each position is estimated."""

MAX_TRIES = 4
"""Number of silhouettes to try before a straight edge is used."""

SHARE_TOLERANCE = 0.05
"""Largest accepted difference between the drawn fraction and the one that a silhouette occludes."""


@dataclasses.dataclass(frozen=True)
class Occlusion:
    """Ranges of the occlusion; values are drawn once per view.

    Attributes:
        share: occluded fraction of the view's pixels.
        none: probability that a view is not occluded.
        straight: probability that an occluded view is occluded by a straight edge (a large object).
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
    angle, width = rng.uniform(0, 2 * np.pi), view.pixel_width
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
    return view.without(pixels[hidden])


@functools.cache
def _silhouettes() -> tuple[NDArray[np.bool_], ...]:
    """Return silhouettes [h, w] of the built-in objects with an empty border; takes 0.2 s, once per process."""
    f = DISTANCE / SILHOUETTE_PIXEL
    camera = Camera.from_field_of_view(400, 400, float(np.degrees(2 * np.arctan(200 / f))))
    casters = [(RayCaster([mesh]), mesh.centre) for mesh in builtin_objects().values()]
    views = (caster.render(camera_pose(*pose, centre), camera) for caster, centre in casters for pose in POSES)
    return tuple(np.pad(view.depth > 0, 1) for view in views)


def _behind_silhouette(
    x: NDArray[np.float64], y: NDArray[np.float64], share: float, scale: float, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """Return which points (x [n], y [n], metres) a silhouette occludes after moving along x until it covers `share`."""
    bank = _silhouettes()
    silhouette = bank[rng.integers(len(bank))]
    pixel = SILHOUETTE_PIXEL * scale
    height, width = silhouette.shape
    sideways = rng.uniform(y.min(), y.max()) / 2
    places = np.linspace(x.min() - width / 2 * pixel, 0, PLACES)

    def hides(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points, relative to the silhouette's centre, are covered by the silhouette."""
        column = (x / pixel + width / 2).astype(np.intp).clip(0, width - 1)
        row = (y / pixel + height / 2).astype(np.intp).clip(0, height - 1)
        return silhouette[row, column]

    sample = slice(None, None, -(-len(x) // SAMPLE_PIXELS))
    shares = hides(x[sample] - places[:, None], y[sample] - sideways).mean(axis=1)
    return hides(x - places[np.argmin(np.abs(shares - share))], y - sideways)


MAX_BACKGROUND_GAP = 2 * PIECE_CELL
"""Largest distance of added background, metres, since outlier removal treats adjacent cells as one component."""


@dataclasses.dataclass(frozen=True)
class Segmentation:
    """Ranges of the mask's error; values are drawn once per view.

    Attributes:
        pixels: number of pixels of a real frame by which the mask is dilated; eroded if negative.
        tilt: angle between the background's normal and the optical axis, degrees.
        touching: probability that the background touches the visible object, as a table does.
        gap: distance between object and background if they do not touch, metres.
    """

    pixels: Range = (-8.0, 6.0)
    tilt: Range = (0.0, 70.0)
    touching: float = 0.7
    gap: Range = (0.0, 0.5)


def resegmented(view: RenderedView, segmentation: Segmentation, rng: np.random.Generator) -> RenderedView:
    """Return the view with a random error of its mask; an eroded mask keeps at least half of the pixels."""
    seen = view.depth > 0
    steps = round(rng.uniform(*segmentation.pixels) * FRAME_PIXEL / view.pixel_width)
    return _dilated(view, steps, segmentation, rng) if steps > 0 else _eroded(view, seen, -steps)


def _eroded(view: RenderedView, seen: NDArray[np.bool_], steps: int) -> RenderedView:
    mask, count = seen, int(seen.sum())
    for _ in range(steps):
        smaller = binary_erosion(mask)
        if 2 * int(smaller.sum()) < count:
            break
        mask = smaller
    return view.without(np.flatnonzero(seen & ~mask))


def _dilated(view: RenderedView, steps: int, segmentation: Segmentation, rng: np.random.Generator) -> RenderedView:
    view = _widened(view, steps)
    seen = view.depth > 0
    plane = _background(view, seen, segmentation, rng)
    added = binary_dilation(seen, iterations=steps) & ~seen & (plane > 0)
    added &= plane <= maximum_filter(view.depth, 2 * steps + 1) + 1000 * MAX_BACKGROUND_GAP
    color, depth = view.color.copy(), view.depth.copy()
    color[added] = rng.integers(0, 256, 3)
    depth[added] = plane[added]
    return dataclasses.replace(view, color=color, depth=depth)


def _widened(view: RenderedView, margin: int) -> RenderedView:
    """Return the view with a margin on all sides, within the image of the training camera."""
    camera, k = TRAINING_CAMERA, view.intrinsics
    sides = []
    for first, length, size in zip(view.corner, view.depth.shape, (camera.height, camera.width), strict=True):
        sides.append((min(margin, first), max(0, min(margin, size - first - length))))
    (top, _), (left, _) = sides
    color, depth = np.pad(view.color, (*sides, (0, 0))), np.pad(view.depth, sides)
    intrinsics = Intrinsics(k.fx, k.fy, k.cx + left, k.cy + top, k.depth_scale)
    return RenderedView(color, depth, intrinsics, view.pose, (view.corner[0] - top, view.corner[1] - left))


def _background(
    view: RenderedView, seen: NDArray[np.bool_], segmentation: Segmentation, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the depth [h, w] of a plane behind the object, millimetres; 0 where it is not visible."""
    tilt, azimuth = np.radians(rng.uniform(*segmentation.tilt)), rng.uniform(0, 2 * np.pi)
    gap = 0.0 if rng.random() < segmentation.touching else rng.uniform(*segmentation.gap)
    k, (height, width) = view.intrinsics, view.depth.shape
    # n . ray is negative where the plane faces the camera; n . point is this value times the depth.
    facing = (
        np.sin(tilt) * np.cos(azimuth) * (np.arange(width) - k.cx) / k.fx
        + (np.sin(tilt) * np.sin(azimuth) * (np.arange(height) - k.cy) / k.fy)[:, None]
        - np.cos(tilt)
    )
    offset = (facing[seen] * view.depth[seen]).min() - 1000 * gap
    depth = offset / np.minimum(facing, -1e-3)
    return np.where(depth < 65535, np.rint(depth), 0).astype(np.uint16)


MAX_CUT = 0.4
"""Largest fraction of the visible pixels that may be removed; without it, a flat object would disappear."""


@dataclasses.dataclass(frozen=True)
class Base:
    """Ranges of the missing base; values are drawn once per view.

    Attributes:
        missing: probability that the base is missing.
        height: height of the missing part, metres.
        upright: probability that the object stands upright like its mesh; otherwise its orientation is random.
    """

    missing: float = 0.4
    height: Range = (0.003, 0.02)
    upright: float = 0.6


def without_base(view: RenderedView, base: Base, rng: np.random.Generator) -> RenderedView:
    """Return the view without the pixels near the table, or unchanged if too many pixels would be removed."""
    pixels = np.flatnonzero(view.depth)
    if rng.random() >= base.missing:
        return view
    up = np.array([0.0, 0.0, 1.0]) if rng.random() < base.upright else rng.standard_normal(3)
    up /= np.linalg.norm(up)
    height = view.frame.points(pixels).astype(np.float32) @ (view.pose[:3, :3].T @ up).astype(np.float32)
    low = height - height.min() < rng.uniform(*base.height)
    return view if low.mean() > MAX_CUT else view.without(pixels[low])


MAX_COPIES = 1000
"""Largest number of augmented copies of a view."""


KINDS: dict[str, tuple[type, Callable[[RenderedView, Any, np.random.Generator], RenderedView]]] = {
    "illumination": (sensing.Illumination, sensing.relit),
    "registration": (sensing.Registration, sensing.misregistered),
    "segmentation": (Segmentation, resegmented),
    "base": (Base, without_base),
    "occlusion": (Occlusion, occluded),
    "sensor": (sensing.Sensor, sensing.sensed),
}
"""The settings of each augmentation and the function that applies it, in the order in which they are applied."""


@dataclasses.dataclass(frozen=True)
class Augmentations:
    """Augmentations to apply; None disables one. The record is falsy if all are disabled.

    Attributes:
        illumination: light and camera response.
        sensor: noise and faults of the depth sensor.
        occlusion: another object in front.
        segmentation: masks that are too small or too large.
        registration: colour that is blurred and shifted against depth.
        base: masks without the lowest part of the object.
        copies: number of augmented copies of each view.

    Raises:
        InputError: `copies` is not from 1 to `MAX_COPIES`.
    """

    illumination: sensing.Illumination | None = None
    sensor: sensing.Sensor | None = None
    occlusion: Occlusion | None = None
    segmentation: Segmentation | None = None
    copies: int = 5
    registration: sensing.Registration | None = None
    base: Base | None = None

    @classmethod
    def of_names(cls, names: Iterable[str], copies: int = 5) -> "Augmentations":
        """Return the augmentations with these names, in their default settings."""
        return cls(**{name: KINDS[name][0]() for name in names}, copies=copies)

    def __post_init__(self) -> None:
        if not 1 <= self.copies <= MAX_COPIES:
            raise InputError(f"copies is {self.copies}; expected an integer from 1 to {MAX_COPIES}")

    def __bool__(self) -> bool:
        return any(getattr(self, name) for name in KINDS)

    def record(self) -> dict[str, Any]:
        """Return all settings in JSON types: None for a disabled augmentation, lists for ranges."""
        return dict(json.loads(json.dumps(dataclasses.asdict(self))))


def augment(view: RenderedView, augmentations: Augmentations, rng: np.random.Generator) -> RenderedView:
    """Return an augmented copy of a view, determined by the arguments and the state of `rng`.

    The order is illumination, registration, segmentation, base, occlusion, sensor. Flying pixels are removed after
    segmentation and sensor, as recognition does, that is, unless they are more than half of all pixels.

    Args:
        view: view as rendered; not modified.
        augmentations: the augmentations to apply, with their settings; an empty view is returned unchanged.
        rng: random number generator.

    Returns:
        A view with the same pose. If the mask is dilated, the image may be larger by some pixels on each side, with
        corner and intrinsics adapted.
    """
    if not view.depth.any():
        return view
    for name, (_, apply) in KINDS.items():
        settings = getattr(augmentations, name)
        view = apply(view, settings, rng) if settings else view
    if not (augmentations.segmentation or augmentations.sensor):
        return view
    pixels = np.flatnonzero(view.depth)
    flying = flying_pixels(view.frame, pixels)
    return view if 2 * flying.sum() > len(pixels) else view.without(pixels[flying])
