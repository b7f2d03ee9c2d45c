"""Twenty simulated cameras, which show a real frame as other RGB-D cameras and segmenters would have seen it.

    seen = through_camera(frame, CHOOSE[0])

A camera changes a whole image like the augmentations change a single view. It changes the response to light, and blurs
colour and shifts it against depth. It adds noise, steps, holes and missing edges to depth. Its masks are too small, too
large or end above the table. The result depends only on the table below and the frame.
"""

import dataclasses
import zlib

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from colornet.colors import LUMA
from thor2_jax.frames.frames import RGBDFrame, backproject
from thor2_jax.frames.outliers import fit_plane
from training.rendering.camera import axial_deviation

__all__ = ["CHOOSE", "REPORT", "SimulatedCamera", "through_camera"]

EDGE_STEP = 0.03
"""Smallest difference in depth within three pixels at which a pixel counts as an edge, metres."""

MIN_MASK = 0.5
"""Smallest fraction of a mask that must remain; otherwise the mask is not changed."""

TABLE_MARGIN = 15
"""Width of the region around the masks in which the table is searched, pixels."""

TABLE_TOLERANCE = 0.006
"""Largest distance of a point of the table to its plane, metres."""


@dataclasses.dataclass(frozen=True)
class SimulatedCamera:
    """A camera and the segmenter that makes its masks; by default, a frame is not changed.

    Attributes:
        name: name in reports.
        gamma: exponent of all channels.
        gain: factor of all channels.
        saturation: factor of a colour's distance from grey.
        warmth: fraction by which red is amplified and blue attenuated; negative for cool light.
        veil: weight of the white that is mixed in.
        blur: standard deviation of the blur of the colour image, pixels.
        noise: standard deviation per pixel and channel, of values from 0 to 1.
        shift: rows down and columns to the right by which colour is shifted against depth.
        axial: standard deviation of depth, as a factor of `axial_deviation`.
        step: depth is rounded to multiples of this, millimetres.
        holes: number of elliptic holes in depth.
        radius: largest half axis of a hole, pixels.
        edges: fraction of the pixels at depth edges that have no depth.
        mask: number of pixels by which masks are dilated; eroded if negative.
        base: height above the table up to which masks lack pixels, metres.
    """

    name: str
    gamma: float = 1.0
    gain: float = 1.0
    saturation: float = 1.0
    warmth: float = 0.0
    veil: float = 0.0
    blur: float = 0.0
    noise: float = 0.0
    shift: tuple[int, int] = (0, 0)
    axial: float = 0.0
    step: int = 1
    holes: int = 0
    radius: int = 14
    edges: float = 0.0
    mask: int = 0
    base: float = 0.0


CHOOSE = (
    SimulatedCamera("warm lamp", gamma=1.1, gain=0.95, warmth=0.15, noise=0.01, shift=(0, 2), axial=0.5, edges=0.1),
    SimulatedCamera("dim room", 1.25, 0.6, 0.9, warmth=0.05, noise=0.02, axial=0.8, edges=0.1, mask=-1),
    SimulatedCamera("pale", saturation=0.55, veil=0.05, noise=0.005, shift=(1, -2), axial=0.5, holes=10, edges=0.2),
    SimulatedCamera("shifted right", 1.05, 0.9, 0.9, warmth=0.03, noise=0.005, shift=(0, 6), axial=0.5, edges=0.2),
    SimulatedCamera("shifted far left", 0.95, 1.05, warmth=-0.03, noise=0.005, shift=(-2, -9), axial=0.5, edges=0.1),
    SimulatedCamera("noisy depth", 1.1, 0.85, 0.8, noise=0.01, shift=(1, 1), axial=1.5, step=3, edges=0.3),
    SimulatedCamera("small holes", 0.9, 0.9, 0.9, noise=0.01, shift=(0, -1), axial=0.6, holes=40, edges=0.6),
    SimulatedCamera("no base", 1.05, 0.9, 0.85, warmth=0.05, noise=0.005, axial=0.4, edges=0.1, base=0.01),
    SimulatedCamera("tight masks", 1.0, 0.8, 1.1, warmth=-0.05, noise=0.01, axial=0.5, edges=0.2, mask=-3, base=0.005),
    SimulatedCamera(
        "worn", 1.2, 0.75, 0.7, 0.1, 0.05, 1.0, 0.015, (3, 5), 1.0, step=2, holes=20, edges=0.3, mask=-2, base=0.008
    ),
)
"""Cameras that may be used to choose settings."""

REPORT = (
    SimulatedCamera("cool daylight", 0.95, 1.1, 1.05, -0.16, noise=0.01, shift=(-2, 1), axial=0.5, edges=0.15),
    SimulatedCamera("overexposed", 0.8, 1.4, 0.9, noise=0.01, shift=(1, 0), axial=0.5, edges=0.1, mask=1),
    SimulatedCamera("vivid", 1.35, 1.1, 1.5, blur=0.7, noise=0.005, axial=0.6, edges=0.2),
    SimulatedCamera("shifted down", 1.1, 0.9, 0.9, -0.05, noise=0.005, shift=(8, 1), axial=0.5, edges=0.2),
    SimulatedCamera("shifted diagonally", 0.9, 0.95, 1.1, 0.06, noise=0.01, shift=(-7, 7), axial=0.6, edges=0.1),
    SimulatedCamera("coarse depth", 1.15, 0.8, 1.15, -0.05, blur=1.0, shift=(2, -2), axial=0.3, step=6, edges=0.1),
    SimulatedCamera("large holes", 0.85, 0.85, 0.8, 0.08, noise=0.01, axial=0.9, holes=8, radius=40, edges=0.4),
    SimulatedCamera("loose masks", 1.1, 1.05, 0.75, noise=0.01, shift=(0, 3), axial=0.7, edges=0.2, mask=3),
    SimulatedCamera("thick table", 0.9, 0.8, 1.2, -0.08, noise=0.005, axial=0.6, edges=0.2, mask=-1, base=0.014),
    SimulatedCamera(
        "cheap", 0.8, 0.8, 1.3, -0.1, 0.1, 1.7, 0.02, (5, -4), 1.8, step=4, holes=15, edges=0.5, mask=2, base=0.012
    ),
)
"""Cameras for the final report only; their errors differ from those of `CHOOSE` in kind or strength."""


def through_camera(frame: RGBDFrame, camera: SimulatedCamera) -> RGBDFrame:
    """Return the frame as a simulated camera sees it; depth becomes uint16 millimetres.

    Args:
        frame: a frame; without labels, masks are not changed.
        camera: a camera of `CHOOSE` or `REPORT`, or any other.
    """
    rng = np.random.default_rng([zlib.crc32(camera.name.encode()), zlib.crc32(np.asarray(frame.depth).tobytes())])
    color = _color(frame.color, camera, rng)
    depth = _depth(frame.depth_m, camera, rng)
    labels = None if frame.labels is None else _labels(frame, camera)
    return RGBDFrame(color, depth, labels, dataclasses.replace(frame.intrinsics, depth_scale=1000.0))


def _color(color: NDArray[np.uint8], camera: SimulatedCamera, rng: np.random.Generator) -> NDArray[np.uint8]:
    values = (color.astype(np.float32) / 255) ** camera.gamma
    values *= camera.gain * np.array([1 + camera.warmth, 1, 1 - camera.warmth], np.float32)
    grey = (values @ LUMA)[..., None]
    values = (grey + camera.saturation * (values - grey)) * (1 - camera.veil) + camera.veil
    values = gaussian_filter(values, (camera.blur, camera.blur, 0))
    (row, column), (height, width) = camera.shift, color.shape[:2]
    rows, columns = (np.arange(n) - s for n, s in ((height, row), (width, column)))
    values = values[rows.clip(0, height - 1)][:, columns.clip(0, width - 1)]
    if camera.noise:
        values += np.float32(camera.noise) * rng.standard_normal(values.shape, np.float32)
    return (255 * values + 0.5).clip(0, 255).astype(np.uint8)


def _depth(depth_m: NDArray[np.float32], camera: SimulatedCamera, rng: np.random.Generator) -> NDArray[np.uint16]:
    deviation = 1000 * camera.axial * axial_deviation(depth_m)
    noisy = 1000 * depth_m + deviation * rng.standard_normal(depth_m.shape, np.float32)
    measured = np.rint(noisy / camera.step) * camera.step
    edge = maximum_filter(depth_m, 3) - minimum_filter(depth_m, 3) > EDGE_STEP
    missing = (depth_m == 0) | (edge & (rng.random(depth_m.shape, np.float32) < camera.edges))
    missing |= _ellipses(depth_m.shape, camera, rng)
    return np.where(missing, 0, measured.clip(1, 65535)).astype(np.uint16)


def _ellipses(shape: tuple[int, ...], camera: SimulatedCamera, rng: np.random.Generator) -> NDArray[np.bool_]:
    holes = np.zeros(shape, bool)
    row, column = np.ogrid[: shape[0], : shape[1]]
    for _ in range(camera.holes):
        y, x = row - rng.uniform(0, shape[0]), column - rng.uniform(0, shape[1])
        (a, b), angle = rng.uniform(2, camera.radius, 2), rng.uniform(0, np.pi)
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        holes |= (along / a) ** 2 + (across / b) ** 2 < 1
    return holes


def _labels(frame: RGBDFrame, camera: SimulatedCamera) -> NDArray[np.integer]:
    changed = labels = frame.label_image
    size = 2 * abs(camera.mask) + 1
    if camera.mask > 0:
        changed = np.where(labels == 0, maximum_filter(labels, size), labels)
    elif camera.mask < 0:
        inside = minimum_filter(labels, size) == maximum_filter(labels, size)
        changed = _cut(changed, ~inside)
    if camera.base:
        changed = _cut(changed, _near_table(frame, camera.base))
    return changed


def _cut(labels: NDArray[np.integer], pixels: NDArray[np.bool_]) -> NDArray[np.integer]:
    """Return the labels without `pixels` [H, W]; masks that would keep less than `MIN_MASK` are not changed."""
    counts = np.bincount(labels.ravel())
    share = np.bincount(labels[pixels], minlength=len(counts)) / np.maximum(counts, 1)
    return np.where(pixels & (share <= 1 - MIN_MASK)[labels], 0, labels).astype(labels.dtype)


def _near_table(frame: RGBDFrame, height: float) -> NDArray[np.bool_]:
    """Return the pixels [H, W] within `height` metres of the plane that fits most points around the masks."""
    points = backproject(frame.depth_m, frame.intrinsics)
    labels, seen = frame.label_image, frame.depth_m > 0
    around = points[seen & (labels == 0) & (maximum_filter(labels, 2 * TABLE_MARGIN + 1) > 0)]
    normal, offset, _ = fit_plane(around[:: len(around) // 4000 + 1], TABLE_TOLERANCE)
    return np.asarray(seen & (np.abs(points @ normal - offset) < height))
