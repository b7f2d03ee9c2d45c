"""Check whether edges of depth, or of labels, lie on edges of colour.

The fields of oriented edges are correlated over all shifts up to `MAX_SHIFT` pixels. Orientations are doubled angles,
so that edges from dark to bright and from bright to dark are equal, and random edges cancel out. In registered frames,
the correlation peaks at a shift of at most three pixels, many standard deviations above the rest.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from training.diagnosis.checks import Diagnosis

__all__ = ["check_labels_alignment", "check_registration"]

MAX_SHIFT = 48
"""Largest shift in the search, pixels of an image with 640 columns."""

MAX_REGISTERED = 8.0
"""Largest shift of a registered frame, pixels of an image with 640 columns. Some cameras shift by a few pixels."""

MIN_EDGES = 150
"""Smallest number of pixels on edges for a finding."""

MIN_EDGES_UNRELATED = 250
"""Smallest number of pixels on edges for the finding that no shift fits, since a box has only a few straight edges."""

MIN_PEAK = 6.0
"""Smallest height of a peak, in standard deviations of the correlation elsewhere."""

MIN_NEAR = 4.0
"""Smallest height near zero shift, in the same unit, at which a frame may be registered."""

MIN_GAIN = 1.25
"""Smallest ratio of a peak to the peak without a shift or a transformation."""

WIDTH = 640

SCALES = (0.75, 0.8, 0.85, 0.9, 1.1, 1.15, 1.2, 1.25, 1.35)

Field = NDArray[np.complex128]


class Alignment(NamedTuple):
    """The best shift of one edge field onto another.

    Attributes:
        right: columns by which the first field must be moved.
        down: rows by which the first field must be moved.
        distance: length of the shift, pixels.
        peak: mean correlation at this shift; 1 is perfect.
        near: largest mean correlation at shifts up to `MAX_REGISTERED`.
        height: `peak` in standard deviations of the correlation at other shifts.
        near_height: `near` in the same unit.
        n_edges: number of pixels on edges of the first field.
    """

    right: int
    down: int
    distance: float
    peak: float
    near: float
    height: float
    near_height: float
    n_edges: int


def _gradient(image: NDArray[Any], sigma: float) -> Field:
    return ndimage.gaussian_filter(image, sigma, (0, 1)) + 1j * ndimage.gaussian_filter(image, sigma, (1, 0))


def _double_angle(gradient: Field) -> Field:
    return (gradient / np.maximum(np.abs(gradient), 1e-9)) ** 2


def color_edges(color: NDArray[np.uint8]) -> Field:
    """Return the oriented edges of a colour image, weighted by their contrast to the surroundings."""
    gradients = np.stack([_gradient(color[..., channel].astype(np.float64), 1.0) for channel in range(3)])
    strongest = np.take_along_axis(gradients, np.abs(gradients).argmax(axis=0)[None], axis=0)[0]
    size = np.abs(strongest)
    usual = ndimage.uniform_filter(size, 41) + 1
    return np.where(size > usual, size / (size + usual), 0) * _double_angle(strongest)


def depth_edges(depth_m: NDArray[np.floating[Any]]) -> Field:
    """Return the oriented steps of a depth image, on the side nearer to the camera."""
    is_valid = depth_m > 0
    if not is_valid.any():
        return np.zeros(depth_m.shape, np.complex128)
    nearest = ndimage.distance_transform_edt(~is_valid, return_distances=False, return_indices=True)
    filled = depth_m[tuple(nearest)].astype(np.float64)
    # Steps are relative, so that the unit of depth does not matter.
    filled /= np.median(filled)
    low, high = ndimage.minimum_filter(filled, 3), ndimage.maximum_filter(filled, 3)
    is_edge = is_valid & (high - low > 0.025 * np.maximum(low, 1)) & (filled <= low + 0.0125)
    return is_edge * _double_angle(_gradient(np.minimum(filled, 5), 1.5))


def label_edges(labels: NDArray[Any]) -> Field:
    """Return the oriented borders of the instances, on their inner side."""
    is_object = (labels != 0).astype(np.float64)
    is_edge = (ndimage.minimum_filter(is_object, 3) != is_object) & (is_object > 0)
    return is_edge * _double_angle(_gradient(is_object, 1.5))


def _reduced(color: NDArray[np.uint8], other: NDArray[Any]) -> tuple[int, Field, NDArray[Any]]:
    """Reduce both images to about `WIDTH` columns; return the step, the spectrum of colour edges and the other image.

    The spectrum is the Fourier transform with a margin of `MAX_SHIFT`, padded to an efficient size.
    """
    step = max(round(color.shape[1] / WIDTH), 1)
    edges = np.pad(color_edges(color[::step, ::step]), MAX_SHIFT)
    spectrum = fft.fft2(edges.astype(np.complex64), [fft.next_fast_len(n) for n in edges.shape])
    return step, spectrum, other[::step, ::step]


def _align(moved: Field, spectrum: Field) -> Alignment:
    """Return the best shift of the edges `moved` [H, W] onto the edges with this spectrum, see `_reduced`."""
    n_edges, reach = int(np.count_nonzero(moved)), MAX_SHIFT
    product = spectrum * np.conj(fft.fft2(moved.astype(np.complex64), spectrum.shape))
    correlation = fft.ifft2(product)[: 2 * reach + 1, : 2 * reach + 1].real / max(n_edges, 1)
    correlation = ndimage.gaussian_filter(correlation, 1)
    down, right = (int(k) - reach for k in np.unravel_index(correlation.argmax(), correlation.shape))
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    elsewhere = correlation[np.hypot(rows - down, columns - right) > 12]
    near, peak = float(correlation[np.hypot(rows, columns) <= MAX_REGISTERED].max()), float(correlation.max())
    spread = max(float(elsewhere.std()), 1e-9)
    return Alignment(right, down, float(np.hypot(right, down)), peak, near, peak / spread, near / spread, n_edges)


def _zoomed(image: NDArray[Any], factor: float) -> NDArray[Any]:
    """Return an image enlarged about its centre, in an array of the same size; 0 outside."""
    places = [np.rint((np.arange(n) - (n - 1) / 2) / factor + (n - 1) / 2).clip(-1, n).astype(int) for n in image.shape]
    return np.pad(image, (0, 1))[np.ix_(*places)]  # outside are the places -1 and n


def check_registration(diagnosis: Diagnosis, color: NDArray[np.uint8], depth_m: NDArray[np.floating[Any]]) -> None:
    """Check whether depth [H, W] is registered to colour [H, W, 3]."""
    step, spectrum, depth_m = _reduced(color, depth_m)
    plain = _align(depth_edges(depth_m), spectrum)
    if plain.n_edges < MIN_EDGES:
        diagnosis.notes.append("registration of colour and depth: not checked, since depth has too few edges")
        return
    if plain.distance <= MAX_REGISTERED and plain.height >= MIN_PEAK:
        return
    candidates = {
        "mirrored": depth_m[:, ::-1],
        "upside down": depth_m[::-1],
        "rotated by 180 degrees": depth_m[::-1, ::-1],
    }
    candidates |= {f"enlarged by a factor of {1 / scale:.2f}": _zoomed(depth_m, scale) for scale in SCALES}
    alignments = {name: _align(depth_edges(each), spectrum) for name, each in candidates.items()}

    def weighted_peak(name: str) -> float:
        return alignments[name].peak * min(1, alignments[name].n_edges / plain.n_edges)

    name = max(alignments, key=weighted_peak)
    best = alignments[name]
    edges = "The edges of the depth image lie on those of the colour image"
    if best.height >= MIN_PEAK and weighted_peak(name) >= MIN_GAIN * plain.peak:
        shift = f", and {_shift(best, step)}" if best.distance > MAX_REGISTERED else ""
        message = f"The depth image is {name} compared with the colour image{shift}: they are not registered."
    elif plain.height >= MIN_PEAK and plain.peak >= MIN_GAIN * plain.near:
        message = f"{edges} only if depth is {_shift(plain, step)}: the images are not registered."
    elif plain.near_height < MIN_NEAR and plain.n_edges >= MIN_EDGES_UNRELATED:
        message = f"{edges} at no shift: the images are not registered, or belong to different frames."
    else:
        return
    advice = "Use the depth image that the camera's driver aligns to the colour image (align_depth, registered depth)."
    diagnosis.add("registration", message, advice)


def check_labels_alignment(diagnosis: Diagnosis, color: NDArray[np.uint8], labels: NDArray[Any]) -> None:
    """Check whether the borders of the instances [H, W] lie on edges of colour [H, W, 3]."""
    step, spectrum, labels = _reduced(color, labels)
    alignment = _align(label_edges(labels), spectrum)
    if alignment.n_edges < MIN_EDGES or alignment.height < MIN_PEAK:
        return
    if alignment.distance > MAX_REGISTERED and alignment.peak >= MIN_GAIN * alignment.near:
        shift = _shift(alignment, step)
        message = f"The borders of the instances lie on edges of the colour image only if labels is {shift}."
        advice = "Check that the label image belongs to this frame and was made from this colour image."
        diagnosis.add("labels-shifted", message, advice)


def _shift(alignment: Alignment, step: int) -> str:
    parts = (alignment.right, "right", "left"), (alignment.down, "down", "up")
    shifts = [f"{abs(n) * step} pixels {positive if n > 0 else negative}" for n, positive, negative in parts if n]
    return "moved " + " and ".join(shifts)
