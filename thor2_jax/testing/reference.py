"""Reference implementation of the descriptor of one aligned cloud, in NumPy and float64."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig

__all__ = ["Reference", "cells", "pixel_masses", "reference_descriptor"]


class Reference(NamedTuple):
    """The reference descriptor of one cloud.

    Attributes:
        images: [S, P, P].
        embeddings: [S, R, J].
        persistence: [S, J], 0 for empty strips.
        counts: [S, J] int, number of points of each strip.
        overflow: number of points outside plus number of strips whose persistence exceeds the window.
    """

    images: NDArray[np.float64]
    embeddings: NDArray[np.float64]
    persistence: NDArray[np.float64]
    counts: NDArray[np.int64]
    overflow: int


def cells(points: NDArray[np.floating], config: DescriptorConfig) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the slice and strip of each point [n, 3] of an aligned cloud; numbers may lie outside the descriptor."""
    x, _, z = points.astype(np.float64).T
    if config.convention == "released":
        level, edges = np.round(z, 1), np.arange(config.n_strips) * config.sigma_2
        return np.searchsorted(np.unique(level), level), np.digitize(np.round(x, 2), edges, right=True)
    i, j = (np.clip(np.floor(at / width), -1, 2**31) for at, width in ((z, config.sigma_1), (x, config.sigma_2)))
    return i.astype(np.int64), j.astype(np.int64)


def pixel_masses(centres: NDArray[np.floating], config: DescriptorConfig) -> NDArray[np.float64]:
    """Return the mass in each pixel of an axis of a Gaussian at each of `centres` [...]: [..., P]."""
    edges = (np.arange(config.image_size + 1) - 1) * config.sigma_2
    return np.diff(ndtr((edges - np.asarray(centres)[..., None]) / np.sqrt(config.image_variance)), axis=-1)


def reference_descriptor(
    points: NDArray[np.floating], rgb: NDArray[np.uint8], network: ColorNetwork, config: DescriptorConfig
) -> Reference:
    """Compute the hard descriptor of one aligned cloud.

    Args:
        points: [n, 3], scaled units, first octant.
        rgb: [n, 3].
        network: the colour network.
        config: of either convention, without relaxation.
    """
    i, j = cells(points, config)
    y = points[:, 1].astype(np.float64)
    released = config.convention == "released"
    y = np.round(y, 2) if released else y
    weights = network.membership(rgb).astype(np.float64)
    shape = (config.n_slices, config.n_strips)
    images = np.zeros((shape[0], config.image_size, config.image_size))
    embeddings = np.zeros((shape[0], network.n_regions, shape[1]))
    persistence, counts = np.zeros(shape), np.zeros(shape, np.int64)
    inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
    for a, b in set(zip(i[inside].tolist(), j[inside].tolist(), strict=True)):
        here = (i == a) & (j == b)
        counts[a, b], persistence[a, b] = here.sum(), np.ptp(y[here])
        births, deaths = (pixel_masses(np.array(c), config) for c in (b * config.sigma_2, persistence[a, b]))
        images[a] += persistence[a, b] ** config.persistence_weight * np.outer(births, deaths)
        embeddings[a, :, b] = weights[here].sum(axis=0) / (counts[a, b] if released else 1) @ network.similarity
    overflow = int((~inside).sum()) + int((persistence > config.window).sum())
    return Reference(images, embeddings, persistence, counts, overflow)
