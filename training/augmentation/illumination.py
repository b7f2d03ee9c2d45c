"""Views under another light and through another camera: colours only, depth stays.

A camera's picture of a scan differs from the scan's texture by the light's strength, colour and direction and by the
camera's response. In this order, on sRGB values in [0, 1]: c ** gamma, times gain, cast and shading; then saturation
(distance from the grey of the same luma), a veil of stray light, noise.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from training.augmentation.settings import Range, check_fields
from training.rendering.camera import RenderedView

__all__ = ["Illumination", "relit"]

LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Shares of red, green and blue in an sRGB value's brightness (ITU-R BT.601)."""

STRIDE = 2
"""Every so many pixels the shading is computed: still finer than the clouds' voxels."""

SMOOTH = 5
"""Side of the square over which slopes are averaged, in these steps: depth is in steps of 1 mm, a pixel 1.4 mm wide."""

STEEPEST = 3.0
"""Slopes beyond this (72 degrees) are steps between surfaces or noise of the rounded depth."""


@dataclasses.dataclass(frozen=True)
class Illumination:
    """Light and camera response, drawn once a view.

    Attributes:
        gamma: exponent of all channels.
        gain: factor of all channels.
        cast: largest deviation from 1 of each channel's own factor. 0.1 is what is left of light of 3,000 K after a
            white balance that takes away four fifths of it.
        shading: weight of the Lambert term of one distant light from a random direction on the camera's side; its mean
            over the view is taken off, so that the gain alone tells the mean brightness.
        saturation: factor of a colour's distance from grey.
        veil: share of white in the mixture.
        noise: standard deviation of a pixel, per channel.

    Raises:
        InputError: a value outside its limits.
    """

    gamma: Range = (0.7, 1.4)
    gain: Range = (0.4, 1.6)
    cast: float = 0.1
    shading: Range = (0.0, 1.0)
    saturation: Range = (0.5, 1.6)
    veil: Range = (0.0, 0.08)
    noise: Range = (0.0, 0.02)

    def __post_init__(self) -> None:
        check_fields(
            self,
            gamma=(0.1, 10),
            gain=(0, 10),
            cast=(0, 0.9),
            shading=(0, 1),
            saturation=(0, 10),
            veil=(0, 1),
            noise=(0, 1),
        )


def relit(view: RenderedView, light: Illumination, rng: np.random.Generator) -> RenderedView:
    """The view under a light drawn from `light`."""
    pixels = np.flatnonzero(view.depth)
    if len(pixels) == 0:
        return view
    gamma, gain, shading, saturation, veil, noise = (
        rng.uniform(*drawn)
        for drawn in (light.gamma, light.gain, light.shading, light.saturation, light.veil, light.noise)
    )
    cast = rng.uniform(1 - light.cast, 1 + light.cast, 3)
    response = ((np.arange(256) / 255) ** gamma).astype(np.float32)
    # Gain, cast, saturation and veil in one matrix: a pixel's grey is the same in all columns.
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
    """Cosine between the normal and the direction to a distant light, 0 where it turns away, at pixels [n]."""
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
    """Smoothed slope of the surface along rows [h, w]: depth a length across."""
    slope, counted = np.zeros((2, *depth.shape), np.float32)
    slope[:, 1:] = focal * np.diff(depth, axis=1) / np.maximum(depth[:, 1:], 1)
    # Beside nothing the slope is as steep as on a step.
    counted[:, 1:] = (depth[:, 1:] > 0) & (np.abs(slope[:, 1:]) < STEEPEST)
    total, weight = (uniform_filter(array, SMOOTH, mode="constant") for array in (slope * counted, counted))
    return total / np.maximum(weight, np.float32(1e-6))
