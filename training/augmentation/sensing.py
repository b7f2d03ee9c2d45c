"""Augmentation of the images of a camera: light, response, registration of colour and depth, and depth.

A camera image of an object differs from the scanned texture by the strength, colour and direction of the light and by
the camera's response. Applied in this order to sRGB values in [0, 1]: c ** gamma; gain, colour cast and shading;
saturation (distance from the grey of the same luma); a veil of stray light; noise.

Some RGB-D cameras blur colour and shift it by up to ten pixels against depth. Points near the outline then have colours
of the background. Compressed video stores chroma (the differences between colours and luma) at half of the resolution.

Depth has noise, is smoothed and rounded to 1 mm, and has missing and flying pixels. Its lateral standard deviation is
at most 0.8 pixels; it is from Nguyen, Izadi and Lovell (2012), like the axial one.
"""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter

from colornet.colors import LUMA
from training.rendering.camera import RenderedView, axial_deviation, depth_edges

__all__ = ["FRAME_PIXEL", "Illumination", "Range", "Registration", "Sensor", "misregistered", "relit", "sensed"]

FRAME_PIXEL = 0.001
"""Width of a pixel of a real frame on the object, metres (f = 616 pixels at 0.6 m, 920 at 0.9 m, 1,067 at 1.1 m).
A pixel of a training view is 1.4 mm wide."""

Range = tuple[float, float]
"""Smallest and largest value of a uniform distribution."""

STRIDE = 2
"""Pixels between computed shading values; this is still finer than the voxels of the clouds."""

SMOOTH = 5
"""Side of the smoothing window for slopes, in strides, since depth is rounded to 1 mm and a pixel is 1.4 mm wide."""

STEEPEST = 3.0
"""Largest slope of a surface; steeper slopes (72 degrees) are depth discontinuities or rounding noise."""


@dataclasses.dataclass(frozen=True)
class Illumination:
    """Ranges of light and camera response; values are drawn once per view.

    Attributes:
        gamma: exponent of all channels.
        gain: factor of all channels.
        cast: largest deviation of the factor of each channel from 1. Light of 3,000 K leaves 0.1 after a white balance
            that corrects four fifths of it. The default is larger, so that networks depend less on colour.
        shading: weight of the Lambert term of one distant light from a random direction on the camera's side. Its mean
            over the view is subtracted, so that only the gain changes the mean brightness.
        saturation: factor of a colour's distance from grey.
        veil: weight of the white that is mixed in.
        noise: standard deviation per pixel and channel.
    """

    gamma: Range = (0.6, 1.6)
    gain: Range = (0.4, 1.7)
    cast: float = 0.25
    shading: Range = (0.0, 1.0)
    saturation: Range = (0.4, 1.7)
    veil: Range = (0.0, 0.12)
    noise: Range = (0.0, 0.02)


def relit(view: RenderedView, light: Illumination, rng: np.random.Generator) -> RenderedView:
    """Return the view under a light drawn from `light`."""
    pixels = np.flatnonzero(view.depth)
    ranges = light.gamma, light.gain, light.shading, light.saturation, light.veil, light.noise
    gamma, gain, shading, saturation, veil, noise = (rng.uniform(*drawn) for drawn in ranges)
    cast = rng.uniform(1 - light.cast, 1 + light.cast, 3)
    response = ((np.arange(256) / 255) ** gamma).astype(np.float32)
    # One matrix applies gain, cast, saturation and veil, since the grey of a pixel is the same in all columns.
    mixing = saturation * np.eye(3) + (1 - saturation) * LUMA[:, None]
    matrix = 255 * (1 - veil) * gain * cast[:, None] * mixing
    color = view.color.copy()
    flat = color.reshape(-1, 3)
    values = response.take(flat.take(pixels, axis=0)) @ matrix.astype(np.float32)
    if shading:
        term = _lambert(view, pixels, rng)
        values *= (1 + np.float32(shading) * (term - term.mean()))[:, None]
    values += np.float32(255 * veil + 0.5)
    if noise:
        values += np.float32(255 * noise) * rng.standard_normal(values.shape, np.float32)
    flat[pixels] = values.clip(0, 255).astype(np.uint8)
    return dataclasses.replace(view, color=color)


def _lambert(view: RenderedView, pixels: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the Lambert term of a random distant light at pixels [n]; 0 where the surface faces away."""
    light = rng.standard_normal(3)
    light[2] = -abs(light[2])
    light /= np.linalg.norm(light)
    depth = view.depth[::STRIDE, ::STRIDE].astype(np.float32)
    across = _slopes(depth, view.intrinsics.fx / STRIDE)
    down = _slopes(depth.T, view.intrinsics.fy / STRIDE).T
    cosine = (across * light[0] + down * light[1] - light[2]) / np.sqrt(across**2 + down**2 + 1)
    row, column = np.divmod(pixels, view.depth.shape[1])
    return cosine.clip(0).astype(np.float32)[row // STRIDE, column // STRIDE]


def _slopes(depth: NDArray[np.float32], focal: float) -> NDArray[np.float32]:
    """Return the smoothed slope of the surface along rows [h, w], as the change of depth per length."""
    slope, counted = np.zeros((2, *depth.shape), np.float32)
    slope[:, 1:] = focal * np.diff(depth, axis=1) / np.maximum(depth[:, 1:], 1)
    # The slope next to missing depth is treated like a discontinuity.
    counted[:, 1:] = (depth[:, 1:] > 0) & (np.abs(slope[:, 1:]) < STEEPEST)
    total, weight = (uniform_filter(array, SMOOTH, mode="constant") for array in (slope * counted, counted))
    return total / np.maximum(weight, np.float32(1e-6))


@dataclasses.dataclass(frozen=True)
class Registration:
    """Ranges of the registration error; values are drawn once per view.

    Attributes:
        shifted: probability of a shift.
        shift: largest shift along rows and columns, in pixels of a real frame.
        blur: standard deviation of the blur of the colour image, in pixels of a real frame.
        chroma: standard deviation of an additional blur of chroma (colour minus luma), in pixels of a real frame, since
            video stores chroma at half of the resolution and drivers smooth it against noise.
    """

    shifted: float = 0.5
    shift: float = 10.0
    blur: Range = (0.0, 3.0)
    chroma: Range = (0.0, 6.0)


def misregistered(view: RenderedView, registration: Registration, rng: np.random.Generator) -> RenderedView:
    """Return the view with a blurred, shifted colour image; the background has one random colour."""
    seen = view.depth > 0
    scale = FRAME_PIXEL / view.pixel_width
    blur, chroma = (rng.uniform(*drawn) * scale for drawn in (registration.blur, registration.chroma))
    shift = np.zeros(2, int)
    if rng.random() < registration.shifted:
        shift = np.rint(rng.uniform(-registration.shift, registration.shift, 2) * scale).astype(int)
    background = rng.integers(0, 256, 3).astype(np.uint8)
    values = view.color.astype(np.float32)
    if blur > 0.1:
        values = blurred(values, seen, blur)
    if chroma > 0.1:
        luma = (values @ LUMA)[..., None]
        values = luma + blurred((values - luma) * seen[..., None], seen, chroma)
    color = values.clip(0, 255).astype(np.uint8)
    margin = int(abs(shift).max())
    (row, column), (height, width) = margin + shift, seen.shape
    padded = np.full((height + 2 * margin, width + 2 * margin, 3), background)
    np.copyto(padded[margin : margin + height, margin : margin + width], color, where=seen[..., None])
    moved = padded[row : row + height, column : column + width]
    return dataclasses.replace(view, color=np.where(seen[..., None], moved, 0).astype(np.uint8))


TRUNCATE = 2.5
"""Range of the Gaussians, in standard deviations; about 1 % of their weight lies outside of it."""


def blurred(values: NDArray[np.float32], seen: NDArray[np.bool_], deviation: float) -> NDArray[np.float32]:
    """Return `values` [h, w] or [h, w, c] blurred by a Gaussian over the pixels `seen` [h, w], ignoring other pixels.

    Args:
        values: 0 outside of `seen`.
        seen: pixels with depth.
        deviation: standard deviation of the Gaussian, pixels.
    """
    weight = gaussian_filter(seen.astype(np.float32), deviation, truncate=TRUNCATE)
    result = gaussian_filter(values, (deviation, deviation, 0)[: values.ndim], truncate=TRUNCATE)
    return np.asarray(result / np.maximum(weight, np.float32(1e-3)).reshape(seen.shape + (1,) * (values.ndim - 2)))


@dataclasses.dataclass(frozen=True)
class Sensor:
    """Ranges of the depth sensor's errors; values are drawn once per view.

    Attributes:
        distance: distance of objects in real frames, metres, which determines the noise.
        axial: factor of `axial_deviation`; within a centimetre, it is 0.4 to 0.55 in real frames.
        lateral: standard deviation of the sampling position along rows and columns, in pixels of a real frame.
        grazing: smallest angle between surface normal and view direction at which a surface counts as an edge, degrees.
        missing: fraction of edge pixels without depth; edges are outlines, depth discontinuities and grazing surfaces.
        flying: fraction of flying pixels among the other edge pixels: their depth is between surface and background.
        background: distance of the background behind the object, metres.
        smooth: standard deviation of the smoothing of depth, in pixels of a real frame. Stereo matching and driver
            filters smooth depth, which correlates the noise and rounds the edges.
        patches: fraction of the image in connected patches without depth, as on dark or shiny surfaces.
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
    """Return the view as measured by a depth camera with errors drawn from `sensor`."""
    pixels = np.flatnonzero(view.depth)
    n = len(pixels)
    deviation = rng.uniform(*sensor.axial) * axial_deviation(rng.uniform(*sensor.distance))
    behind = rng.uniform(*sensor.background)
    width = view.pixel_width
    lateral = sensor.lateral * FRAME_PIXEL / width
    # With a margin without depth, the border of the view is an edge, and lateral samples may fall into the margin.
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
    return dataclasses.replace(view, depth=depth).without(pixels[lost])


def _patches(shape: tuple[int, ...], share: float, size: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return pixels [h, w] in random patches of `size` pixels that cover about `share` of the image."""
    height, width = shape
    # Noise is drawn for blocks of 2 x 2 pixels, which takes a third of the time.
    noise = gaussian_filter(rng.standard_normal(((height + 1) // 2, (width + 1) // 2), np.float32), size / 2)
    inside = noise < np.quantile(noise, share)
    return inside.repeat(2, axis=0)[:height].repeat(2, axis=1)[:, :width]
