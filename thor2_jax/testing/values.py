"""Properties of the values of descriptors: masses, linearity, stability, agreement with the equations, and limits.

`reference_descriptor` evaluates the equations in NumPy and float64.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig, Relaxation
from thor2_jax.testing.comparing import (
    UNIT,
    assert_within,
    embedding_rounding,
    image_lipschitz,
    image_rounding,
    joined,
    taken,
    with_points,
)
from thor2_jax.testing.laws import Describe
from thor2_jax.types import Descriptors, Diagrams, PointClouds, Strips

__all__ = [
    "assert_color_mass",
    "assert_embedding_additive",
    "assert_embedding_linear",
    "assert_follows_equations",
    "assert_image_mass",
    "assert_overflow_told",
    "assert_relaxation_converges",
    "assert_stable",
    "moved_within_strips",
    "reference_descriptor",
]


class Reference(NamedTuple):
    """The reference descriptor of one cloud.

    Attributes:
        images: [S, P, P].
        embeddings: [S, R, J].
        persistence: [S, J], 0 for empty strips.
        counts: [S, J] int, number of points of each strip.
        overflow: number of points outside the grid plus number of strips whose persistence exceeds the window.
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
        config: config with either convention, without relaxation.
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


def assert_image_mass(images: NDArray[np.floating], diagrams: Diagrams, config: DescriptorConfig) -> None:
    """Assert that the pixels of an image sum to the persistences, each times the mass of its Gaussian in the window.

    The sum is at most the sum of the persistences, and close to it unless pairs lie within about 3 sigma of the border.
    Masses are computed in float64; the tolerance is the rounding error of an image.

    Args:
        images: [..., S, P, P].
        diagrams: diagrams of the same clouds, fields [..., S, J].
        config: config with a persistence weight of 1.
    """
    births, deaths = (np.asarray(a, np.float64) for a in (diagrams.births, diagrams.deaths))
    persistence = np.where(diagrams.mask, deaths - births, 0)
    inside = [pixel_masses(centres, config).sum(axis=-1) for centres in (births, persistence)]
    expected = (persistence * inside[0] * inside[1]).sum(axis=-1)
    total, most = np.asarray(images, np.float64).sum(axis=(-2, -1)), persistence.sum(axis=-1)
    # Births and deaths are rounded, so the error of their difference is 2 units of the death.
    difference = image_rounding(most, config) + 2 * UNIT * (deaths * image_lipschitz(persistence, config)).sum(axis=-1)
    assert_within("mass", total, expected, difference)
    assert (total <= most + difference).all()


def assert_color_mass(strips: Strips, clouds: PointClouds) -> None:
    """Assert that colour vectors sum to the number of points that do not overflow.

    Weights 1/m are rounded, and so are sums over at most 32 regions and over all strips.
    """
    points = np.asarray(clouds.mask).sum(axis=1)
    total = np.asarray(strips.color, np.float64).sum(axis=(-3, -2, -1)) + np.asarray(strips.overflow)
    assert_within("mass", total, points, embedding_rounding(strips.color.shape[-1]) * points)


def assert_embedding_linear(
    describe_with: Callable[[PointClouds, NDArray[np.float32]], Descriptors],
    clouds: PointClouds,
    similarities: tuple[NDArray[np.float32], NDArray[np.float32]],
    factors: tuple[float, float],
) -> None:
    """Assert that E = (C Delta)^T is linear in Delta and that images do not depend on Delta.

    The tolerance is the rounding error of products with entries of any sign: the counts times the absolute entries.

    Args:
        describe_with: function of clouds and a similarity [R, R].
        clouds: any clouds.
        similarities: two matrices with entries of any sign.
        factors: coefficients of the linear combination.
    """
    combined = factors[0] * similarities[0] + factors[1] * similarities[1]
    first, second, descriptors = (describe_with(clouds, np.asarray(s, np.float32)) for s in (*similarities, combined))
    size = sum(abs(f) * np.abs(s) for f, s in zip(factors, similarities, strict=True))
    bound = np.asarray(describe_with(clouds, np.asarray(size, np.float32)).embeddings, np.float64)
    expected = sum(f * np.asarray(d.embeddings, np.float64) for f, d in zip(factors, (first, second), strict=True))
    rounding = 2 * embedding_rounding(descriptors.embeddings.shape[-2]) * bound
    assert_within("embeddings", descriptors.embeddings, expected, rounding)
    for other in (first, second):
        np.testing.assert_array_equal(other.images, descriptors.images)


def assert_embedding_additive(describe: Describe, first: PointClouds, second: PointClouds) -> None:
    """Assert that the embedding of the union of two aligned clouds is the sum of both embeddings (paper's convention).

    Args:
        describe: function of aligned clouds.
        first: clouds that are at most half full.
        second: as many clouds of the same capacity, at most half full.
    """
    half = np.arange(first.mask.shape[1] // 2)
    union = joined(taken(first, half), taken(second, half))
    a, b, both = (np.asarray(describe(c).embeddings, np.float64) for c in (first, second, union))
    assert_within("embeddings", a + b, both, 2 * embedding_rounding(both.shape[-2]) * both)


def moved_within_strips(aligned: PointClouds, config: DescriptorConfig, seed: int, eps: float) -> PointClouds:
    """Move every point by at most `eps` along each axis without leaving its strip and slice."""
    rng = np.random.default_rng(seed)
    points = np.asarray(aligned.points, np.float64)
    # The worst case, drawn half of the time, moves all points outwards.
    step = eps * np.sign(points - points.mean(axis=1, keepdims=True))
    if rng.random() < 0.5:
        step = rng.uniform(-eps, eps, points.shape)
    for axis, width in ((0, config.sigma_2), (2, config.sigma_1)):
        low = np.floor(points[..., axis] / width) * width
        least = np.where(points[..., axis] == 0, 0, low + 0.02 * width)
        step[..., axis] = np.clip(points[..., axis] + step[..., axis], least, low + 0.98 * width) - points[..., axis]
    return with_points(aligned, points + step)


def assert_stable(
    describe: Describe,
    diagrams: Callable[[PointClouds], Diagrams],
    before: PointClouds,
    after: PointClouds,
    eps: float,
    config: DescriptorConfig,
) -> float:
    """Assert that moving points by at most eps within their strips changes each image by at most the proven bound.

    Births do not change and each extreme moves by at most eps, so that the 1-Wasserstein distance W1 of the diagrams is
    at most 2 eps for each pair. By the theorem for Gaussians of Adams et al. (JMLR 2017), the difference of the images,
    summed over pixels, is at most (sqrt(5) |f'| + sqrt(10 / pi) |f| / sigma) W1 for the weight f = p, with |f'| = 1 and
    |f| the largest persistence. Both steps are checked, the second with the tighter constant for fixed births and the
    persistence of each pair, which is smaller by a factor of at least sqrt(5).

    Args:
        describe: function of aligned clouds.
        diagrams: function of aligned clouds.
        before: `settled` clouds.
        after: the same clouds, moved by `moved_within_strips`.
        eps: scaled units.
        config: config with a persistence weight of 1.

    Returns:
        The largest quotient of the change of an image and its bound, at most 1 / sqrt(5) up to rounding.
    """
    pairs = [diagrams(clouds) for clouds in (before, after)]
    np.testing.assert_array_equal(pairs[0].mask, pairs[1].mask)
    np.testing.assert_array_equal(pairs[0].births, pairs[1].births)
    p, q = (np.where(d.mask, np.asarray(d.deaths, np.float64) - np.asarray(d.births, np.float64), 0) for d in pairs)
    largest = np.maximum(p, q)
    rounding = 8 * UNIT * (1 + np.abs(np.asarray(before.points)).max(initial=0))
    moves = np.abs(p - q)
    assert moves.max(initial=0) <= 2 * eps + rounding, f"a pair moves by {moves.max():.3g}, points by {eps:.3g}"
    images = [np.asarray(describe(clouds).images, np.float64) for clouds in (before, after)]
    difference = np.abs(images[0] - images[1]).sum(axis=(-2, -1))
    slack = 2 * image_rounding(largest.sum(axis=-1), config) + rounding * image_lipschitz(largest, config).sum(axis=-1)
    tight = (moves * image_lipschitz(largest, config)).sum(axis=-1)
    assert (difference <= tight + slack).all(), f"an image moves by {difference.max():.3g}"
    constant = math.sqrt(5) * image_lipschitz(largest.max(axis=-1, initial=0), config)
    bound = constant * moves.sum(axis=-1)
    return float((difference / np.where(bound > 100 * slack, bound, np.inf)).max(initial=0))


def _references(aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> list[Reference]:
    clouds = [(xyz, np.floor(rgb * 255 + 0.5).astype(np.uint8)) for xyz, rgb in aligned.unpack()]
    return [reference_descriptor(xyz, rgb, network, config) for xyz, rgb in clouds]


def assert_follows_equations(
    describe: Describe, aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig
) -> None:
    """Assert that descriptors equal those of `reference_descriptor` up to rounding.

    This holds for every cloud in the released convention, and for `settled` clouds in the paper's convention, where a
    quotient rounded to float32 can cross the border of a strip. Coordinates below 2 add 2 units to the error of a
    persistence.

    Args:
        describe: function of aligned clouds.
        aligned: aligned clouds.
        network: the colour network.
        config: config without relaxation.
    """
    descriptors = describe(aligned)
    for b, expected in enumerate(_references(aligned, network, config)):
        assert int(descriptors.overflow[b]) == expected.overflow
        drift = 8 * UNIT * image_lipschitz(expected.persistence, config).sum(axis=-1)
        bound = image_rounding(expected.persistence.sum(axis=-1), config) + drift
        assert_within("images", descriptors.images[b], expected.images, bound, summed=(-2, -1))
        bound = 2 * embedding_rounding(network.n_regions) * expected.embeddings
        assert_within("embeddings", descriptors.embeddings[b], expected.embeddings, bound)


def assert_overflow_told(
    describe: Describe, aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig
) -> None:
    """Assert that `overflow` counts exactly the points and pairs that the descriptor leaves out.

    The same count is computed in NumPy. If it is 0, every point is in the embedding and every pair in the window.
    """
    counted = [reference.overflow for reference in _references(aligned, network, config)]
    descriptors = describe(aligned)
    assert np.asarray(descriptors.overflow).tolist() == counted
    for name in ("images", "embeddings"):
        assert np.isfinite(np.asarray(getattr(descriptors, name))).all(), name


def assert_relaxation_converges(
    describe_at: Callable[[PointClouds, DescriptorConfig], Descriptors],
    aligned: PointClouds,
    network: ColorNetwork,
    config: DescriptorConfig,
    factor: float,
) -> None:
    """Assert that the relaxed descriptor converges to the hard one, with a bias of at most T log(2 n).

    On `settled` clouds the weights are 1 up to exp(-margin / T), at most exp(-25) if the default temperatures are
    multiplied by a `factor` of at most 0.02. Each extreme of a strip of n points is then within T log(2 n) of the hard
    one, for the temperature T of extrema: a log-sum-exp exceeds the greatest term by at most T log n and falls below it
    by at most T log 2. 8-bit colours are at least 0.1 levels away from a tie and get the hard regions.

    Args:
        describe_at: function of aligned clouds and a config.
        aligned: clouds settled with a margin of 0.2 or more.
        network: the colour network.
        config: a config without relaxation.
        factor: multiplies the default temperatures, at most 0.02.
    """
    soft = Relaxation(**{name: factor * value for name, value in dataclasses.asdict(Relaxation()).items()})
    descriptors = describe_at(aligned, dataclasses.replace(config, relaxation=soft))
    hard = describe_at(aligned, config)
    np.testing.assert_array_equal(descriptors.overflow, hard.overflow)
    leak = math.exp(-0.2 * min(config.sigma_2 / soft.strip, config.sigma_1 / soft.slice))
    for b, expected in enumerate(_references(aligned, network, config)):
        n = expected.counts.sum()
        bias = 2 * soft.extremum * np.log(2 * np.maximum(expected.counts, 1)) * (expected.counts > 0)
        moved = bias + 2 * n * leak + 16 * UNIT
        constant = image_lipschitz(expected.persistence + moved, config)
        most = (expected.persistence + moved).sum(axis=-1)
        bound = (moved * constant).sum(axis=-1) + 2 * image_rounding(most, config)
        assert_within("images", descriptors.images[b], hard.images[b], bound, summed=(-2, -1))
        # Weights are sums of n exponentials and softmaxes of 27 values, each accurate to a few units.
        bound = 100 * UNIT * np.asarray(hard.embeddings[b]) + n * (leak + 64 * UNIT)
        assert_within("embeddings", descriptors.embeddings[b], hard.embeddings[b], bound)
