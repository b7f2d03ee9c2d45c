"""Comparison of descriptors with derived tolerances, and operations on batches.

Tolerances are bounds on the difference of two float32 computations of the same quantity.

u = 2^-24 is the unit roundoff of float32. A sum of n terms has a relative error of at most n u in any order, to first
order in u (Higham, Accuracy and Stability of Numerical Algorithms, chapter 4).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import ROWS
from thor2_jax.types import Descriptors, PointClouds

__all__ = [
    "UNIT",
    "alignment_drift",
    "assert_equal",
    "assert_near",
    "assert_within",
    "embedding_rounding",
    "image_lipschitz",
    "image_rounding",
    "joined",
    "map_points",
    "taken",
    "with_points",
]

UNIT = 2.0**-24
"""Unit roundoff of float32."""

_TABLE_ERROR = 8 * UNIT
"""Error of an entry of an image's tables, which is half a difference of two error functions. erf in float32 is accurate
to 5 units, and the rounding of its argument, 3 units relative, adds 3 max z erf'(z) < 1.5."""


def image_rounding(persistence: NDArray[np.float64], config: DescriptorConfig) -> NDArray[np.float64]:
    """Return a bound on the rounding error of an image, summed over its pixels.

    A pixel is the sum over J pairs of weight x entry x entry. Over a row of P pixels, the entries sum to at most 1 and
    their errors to at most P table errors. This gives 2 P table errors per pair for both axes, plus J + 2 units for the
    sum and the products. Two computations differ by at most twice this bound.

    Args:
        persistence: [...], sum of the weights of the pairs.
        config: gives P and J.

    Returns:
        [...], the shape of `persistence`.
    """
    return persistence * (2 * config.image_size * _TABLE_ERROR + (config.n_strips + 2) * UNIT)


def image_lipschitz(persistence: NDArray[np.float64], config: DescriptorConfig) -> NDArray[np.float64]:
    """Return the largest change of an image, summed over its pixels, per change of the persistence of a pair.

    The weight p changes by 1, and the Gaussian with this weight by the total variation of its shift,
    sqrt(2 / pi) / sigma. The theorem for Gaussians of Adams et al. (JMLR 2017, "Stability of persistence surfaces and
    images") also allows births to move; its bound is sqrt(5) times as large for a 1-Wasserstein distance of 1.

    Args:
        persistence: [...], the larger persistence of each pair before and after the change.
        config: gives the variance.
    """
    return 1 + math.sqrt(2 / math.pi / config.image_variance) * persistence


def embedding_rounding(n_regions: int) -> float:
    """Return the relative rounding error of an embedding of non-negative counts and similarities.

    It covers a product with the weights of at most 2^7 region sets, one with the similarity, and the rounded weights.
    """
    return (2**7 + n_regions + 3) * UNIT


def alignment_drift(clouds: PointClouds, config: DescriptorConfig) -> float:
    """Return the distance by which rounding may move an aligned point, between two poses or orders of the same clouds.

    The bound holds for `decided_clouds`, whose box has the principal axes. After rounding and scaling, the error of a
    coordinate of size D is 2 u D, and that of a point d = 2 sqrt(3) u D. The error of the second moments, with largest
    eigenvalue l, is at most 2 d sqrt(l), plus the rounding of their sums over N points, (N / 16 + 16) u times the
    trace; the symmetric eigensolver adds about ten units. An axis rotates by at most sqrt(2) times this error over the
    gap of the eigenvalues (Davis and Kahan). A point at a distance R moves by R times the angle, by d, and by the
    rounding of two rotations, 16 u R. The shift to the first octant is the coordinate of some point, which doubles the
    error, and both computations have it, which doubles it again.

    Args:
        clouds: metres, in the pose farther from the origin.
        config: gives sigma_s.
    """
    worst = 0.0
    for points, mask in zip(np.asarray(clouds.points, np.float64), np.asarray(clouds.mask), strict=True):
        scaled = points[mask] * config.sigma_s
        centred = scaled - scaled.mean(axis=0)
        values = np.linalg.eigvalsh(centred.T @ centred / len(centred))
        off = 2 * math.sqrt(3) * UNIT * float(np.abs(scaled).max())
        sums = (len(mask) / ROWS + ROWS + 10) * UNIT * float(values.sum())
        angle = math.sqrt(2) * (2 * off * math.sqrt(values[2]) + sums) / float(np.diff(values).min())
        reach = float(np.linalg.norm(centred, axis=1).max())
        worst = max(worst, 4 * (reach * (angle + 16 * UNIT) + off))
    return worst


def with_points(clouds: PointClouds, points: NDArray[np.floating]) -> PointClouds:
    """Return clouds with new points [B, N, 3], rounded to float32, and padding set to 0."""
    kept = np.where(np.asarray(clouds.mask)[..., None], points, 0)
    return dataclasses.replace(clouds, points=jnp.asarray(kept, jnp.float32))


def assert_equal(actual: Descriptors, expected: Descriptors) -> None:
    """Assert that descriptors are finite and equal bit by bit."""
    for field in dataclasses.fields(Descriptors):
        a, b = (np.asarray(getattr(d, field.name)) for d in (actual, expected))
        assert np.isfinite(b).all(), f"{field.name}: {int((~np.isfinite(b)).sum())} numbers are not finite"
        np.testing.assert_array_equal(a, b, err_msg=field.name)


def assert_within(
    name: str, actual: ArrayLike, expected: ArrayLike, bound: ArrayLike, summed: tuple[int, ...] = ()
) -> None:
    """Assert that arrays differ by at most `bound`, where absolute differences are summed over the axes `summed`."""
    off = np.abs(np.asarray(actual, np.float64) - np.asarray(expected, np.float64)).sum(axis=summed)
    assert (off <= bound).all(), f"{name}: off by {off.max():.3g}; expected at most {np.max(bound):.3g}"


def assert_near(actual: Descriptors, expected: Descriptors, config: DescriptorConfig, drift: float | None) -> None:
    """Assert that descriptors are equal up to rounding, if each aligned point moved by at most `drift` in its strip.

    Births and counts are then equal, and each persistence changes by at most 2 `drift`. The change of an image, summed
    over its pixels, is at most this times the Lipschitz constant plus twice the rounding error; an embedding changes
    only by rounding. The sum of persistences is estimated from the image, which has at least 0.47 of each pair's mass.

    Args:
        actual: descriptors.
        expected: descriptors with a non-negative similarity.
        config: the config of both.
        drift: scaled units; None to require equal bits, as `assert_equal`.
    """
    if drift is None:
        return assert_equal(actual, expected)
    np.testing.assert_array_equal(actual.overflow, expected.overflow, err_msg="overflow")
    images = np.asarray(expected.images, np.float64)
    persistence = images.sum(axis=(-2, -1)) / 0.47
    moved = 2 * drift * (config.n_strips - 1 + image_lipschitz(persistence, config))
    assert_within("images", actual.images, images, moved + 2 * image_rounding(persistence, config), summed=(-2, -1))
    colors = np.asarray(expected.embeddings, np.float64)
    assert_within("embeddings", actual.embeddings, colors, 2 * embedding_rounding(colors.shape[-2]) * np.abs(colors))


def map_points(function: Callable[..., jax.Array], *batches: PointClouds) -> PointClouds:
    """Return the first batch, with `function` of the batches' arrays for each field with an entry per point."""
    fields: dict[str, Any] = {}
    for name in ("points", "colors", "mask", "boundary", "rim"):
        arrays = [getattr(batch, name) for batch in batches]
        fields[name] = None if any(array is None for array in arrays) else function(*arrays)  # an unknown rim
    return dataclasses.replace(batches[0], **fields)


def joined(*batches: PointClouds) -> PointClouds:
    """Concatenate the points of batches: cloud b of the result has the points of cloud b of each batch."""
    return map_points(lambda *arrays: jnp.concatenate(arrays, axis=1), *batches)


def taken(clouds: PointClouds, order: NDArray[np.intp]) -> PointClouds:
    """Select the points of each cloud with the indices `order`, [M] or [B, M]; cameras are unchanged."""
    return map_points(lambda a: a[np.arange(len(a))[:, None], order], clouds)
