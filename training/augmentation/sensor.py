"""Augmentation of the depth sensor: noise, smoothing, missing and flying pixels, depth rounded to 1 mm.

The lateral standard deviation is at most 0.8 pixels (Nguyen, Izadi and Lovell 2012, as the axial one).
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from training.augmentation.pixels import FRAME_PIXEL, Range, blurred, pixel_width, without
from training.rendering.depth_camera import axial_deviation, depth_edges
from training.rendering.view_sphere import RenderedView

__all__ = ["Sensor", "sensed"]


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Ranges of the depth sensor's errors; values are drawn once per view.

    Attributes:
        distance: distance of objects in real frames, metres, which determines the noise.
        axial: factor of `axial_deviation`; real frames have 0.4 to 0.55 of it within a centimetre.
        lateral: standard deviation of the sampling position along rows and columns, in pixels of a real frame.
        grazing: angle between surface normal and view direction from which a surface counts as an edge, degrees.
        missing: share of edge pixels without depth; edges are outlines, depth discontinuities and grazing surfaces.
        flying: share of the other edge pixels whose depth lies between the surface's and the background's.
        background: distance of the background behind the object, metres.
        smooth: standard deviation of the smoothing of depth, in pixels of a real frame. Stereo matching and the filters
            of drivers smooth depth, so that noise is correlated and edges are round.
        patches: share of the image in connected patches without depth, as on dark or shiny surfaces.
        patch: width of these patches, in pixels of a real frame.
    """

    distance: Range = (0.6, 1.2)
    axial: Range = (0.3, 1.5)
    lateral: float = 0.8
    grazing: float = 78.0
    missing: float = 0.3
    flying: float = 0.3
    background: Range = (0.1, 1.0)
    smooth: Range = (0.0, 2.0)
    patches: Range = (0.0, 0.2)
    patch: Range = (2.0, 8.0)


def sensed(view: RenderedView, sensor: Sensor, rng: np.random.Generator) -> RenderedView:
    """Return the view as a depth camera drawn from `sensor` measures it."""
    pixels = np.flatnonzero(view.depth)
    n = len(pixels)
    deviation = rng.uniform(*sensor.axial) * axial_deviation(rng.uniform(*sensor.distance))
    behind = rng.uniform(*sensor.background)
    width = pixel_width(view)
    lateral = sensor.lateral * FRAME_PIXEL / width
    # The margin has no depth, so that the border of the view is an edge and lateral samples can fall there.
    margin = 1 + math.ceil(4 * lateral)
    padded = np.pad(view.depth, margin).astype(np.float32)
    edge = depth_edges(padded, 1000 * width * math.tan(math.radians(sensor.grazing)))
    shift = np.rint(np.float32(lateral) * rng.standard_normal((2, n), np.float32)).clip(-margin, margin)
    row, column = np.divmod(pixels, view.depth.shape[1])
    at = (row + margin) * padded.shape[1] + column + margin
    at += (shift[0] * padded.shape[1] + shift[1]).astype(np.intp)
    sampled, on_edge = padded.take(at), np.flatnonzero(edge.take(at))
    lost = sampled == 0
    chance = rng.random((2, len(on_edge)), np.float32)
    lost[on_edge[chance[0] < sensor.missing]] = True
    mixed = on_edge[chance[1] < sensor.flying]
    sampled[sampled > 0] += np.float32(1000 * deviation) * rng.standard_normal(np.count_nonzero(sampled), np.float32)
    measured = np.zeros(view.depth.shape, np.float32)
    measured.reshape(-1)[pixels] = sampled
    scale = FRAME_PIXEL / width
    smooth = scale * rng.uniform(*sensor.smooth)
    if smooth > 0.1:
        seen = measured > 0
        measured = np.where(seen, blurred(measured, seen, smooth), 0)
    measured.reshape(-1)[pixels[mixed]] += np.float32(1000 * behind) * rng.random(len(mixed), np.float32)
    share, patch = rng.uniform(*sensor.patches), scale * rng.uniform(*sensor.patch)
    lost |= _patches(view.depth.shape, share, patch, rng).take(pixels)
    depth = np.rint(measured).clip(0, 65535).astype(np.uint16)
    return without(dataclasses.replace(view, depth=depth), pixels[lost])


def _patches(shape: tuple[int, ...], share: float, size: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return pixels [h, w] in random patches of `size` pixels that cover about `share` of the image."""
    height, width = shape
    # Noise is drawn for blocks of 2 x 2 pixels, which takes a third of the time.
    noise = gaussian_filter(rng.standard_normal(((height + 1) // 2, (width + 1) // 2), np.float32), size / 2)
    inside = noise < np.quantile(noise, share)
    return inside.repeat(2, axis=0)[:height].repeat(2, axis=1)[:, :width]
