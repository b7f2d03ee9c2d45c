"""Laws of descriptors: one assertion for each, for any function that computes them.

    @given(packed(aligned_clouds(config), size=4, capacity=512), seeds())
    def test_order(clouds, seed):
        assert_permutation_invariant(my_descriptor, clouds, seed)

Each docstring states whether the property holds bit by bit. Otherwise the assertion takes a `drift`, the distance by
which rounding may move an aligned point (`alignment_drift`), from which the bounds on images and embeddings follow
(`assert_near`). The default `drift=None`, for functions of aligned clouds, requires equal bits.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from colornet import ColorNetwork, grid_index
from colornet.grid import grid_colors
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.bounding_box import ROWS
from thor2_jax.types import Descriptors, PointClouds

__all__ = [
    "alignment_drift",
    "assert_batch_size_invariant",
    "assert_company_invariant",
    "assert_duplicates_count_twice",
    "assert_equal",
    "assert_follows_equations",
    "assert_object_unity",
    "assert_padding_invariant",
    "assert_permutation_invariant",
    "assert_rigid_motion_invariant",
    "assert_same_regions_alike",
    "assert_scale_invariant",
    "reference_descriptor",
]

Describe = Callable[[PointClouds], Descriptors]

UNIT = 2.0**-24
"""Unit roundoff u of float32. Tolerances bound the difference of two float32 computations of a quantity: a sum of n
terms has a relative error of at most n u in any order, to first order in u (Higham, Accuracy and Stability of Numerical
Algorithms, chapter 4)."""

_TABLE_ERROR = 8 * UNIT
"""Error of an entry of the tables of an image, half a difference of two error functions: erf in float32 is accurate to
5 units, and the rounding of its argument, 3 units relative, adds 3 max z erf'(z) < 1.5."""


def image_rounding(persistence: NDArray[np.float64], config: DescriptorConfig) -> NDArray[np.float64]:
    """Return a bound on the rounding error of an image, summed over its pixels.

    A pixel is the sum over J pairs of weight x entry x entry. Over a row of P pixels the entries sum to at most 1, and
    so do their errors to at most P table errors: 2 P of these a pair for both axes, and J + 2 units for the sum and the
    products. Two computations differ by twice as much.

    Args:
        persistence: [...], sum of the weights of the pairs.
        config: gives P and J.

    Returns:
        [...], as `persistence`.
    """
    return persistence * (2 * config.image_size * _TABLE_ERROR + (config.n_strips + 2) * UNIT)


def image_lipschitz(persistence: NDArray[np.float64], config: DescriptorConfig) -> NDArray[np.float64]:
    """Return the largest change of an image, summed over its pixels, per change of the persistence of a pair.

    The weight p changes by 1 and the Gaussian by the total variation of its shift, sqrt(2 / pi) / sigma, of which there
    is p. The theorem for Gaussians of Adams et al. (JMLR 2017, "Stability of persistence surfaces and images") allows
    births to move as well and bounds the change by sqrt(5) times as much for a move of 1 in the 1-Wasserstein distance.

    Args:
        persistence: [...], the larger persistence of each pair before and after the change.
        config: gives the variance.
    """
    return 1 + np.sqrt(2 / np.pi / config.image_variance) * persistence


def embedding_rounding(n_regions: int) -> float:
    """Return the relative rounding error of an embedding of non-negative counts and similarities.

    A product with the weights of at most 2^7 sets of regions, and one with the similarity; weights are rounded once.
    """
    return (2**7 + n_regions + 3) * UNIT


def alignment_drift(clouds: PointClouds, config: DescriptorConfig) -> float:
    """Return the distance by which rounding may move an aligned point, between two poses or orders of the same clouds.

    For `decided_clouds`, whose box has the principal axes. Rounded and scaled, a coordinate of size D is off by 2 u D:
    a point by d = 2 sqrt(3) u D. So second moments, of largest eigenvalue l, are off by at most 2 d sqrt(l), and by the
    rounding of their sums over N points, N / 16 + 16 u times the trace; the symmetric eigensolver adds some ten units.
    An axis turns by at most sqrt(2) times that over the gap of the eigenvalues (Davis and Kahan), and a point at a
    distance R by R times the angle, by d, and by the rounding of two rotations, 16 u R. The shift to the first octant
    is that of some point, hence twice as much, and both computations may err: four times.

    Args:
        clouds: metres, in the pose farther from the origin.
        config: gives sigma_s.
    """
    worst = 0.0
    for points, mask in zip(np.asarray(clouds.points, np.float64), np.asarray(clouds.mask), strict=True):
        scaled = points[mask] * config.sigma_s
        centred = scaled - scaled.mean(axis=0)
        values = np.linalg.eigvalsh(centred.T @ centred / len(centred))
        off = 2 * np.sqrt(3) * UNIT * float(np.abs(scaled).max())
        sums = (len(mask) / ROWS + ROWS + 10) * UNIT * float(values.sum())
        angle = np.sqrt(2) * (2 * off * np.sqrt(values[2]) + sums) / float(np.diff(values).min())
        reach = float(np.linalg.norm(centred, axis=1).max())
        worst = max(worst, 4 * (reach * (angle + 16 * UNIT) + off))
    return worst


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


def assert_near(
    actual: Descriptors, expected: Descriptors, config: DescriptorConfig, drift: float | None = 0.0
) -> None:
    """Assert that descriptors are equal up to rounding, if each aligned point moved by at most `drift` in its strip.

    Births and counts are then equal, and each persistence changes by at most 2 `drift`. An image, summed over its
    pixels, changes by that times its Lipschitz constant plus twice its rounding error; an embedding changes by rounding
    only. The sum of persistences is estimated from the image, which has at least 0.47 of the mass of each pair.

    Args:
        actual: descriptors.
        expected: descriptors with a non-negative similarity.
        config: the config of both.
        drift: scaled units; None requires equal bits.
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


def map_points(function: Callable[[jax.Array], jax.Array], clouds: PointClouds) -> PointClouds:
    """Return clouds with the result of a function of each array that has an entry for every point."""
    names = ("points", "colors", "mask", "boundary")
    return dataclasses.replace(clouds, **{name: function(getattr(clouds, name)) for name in names})


def taken(clouds: PointClouds, order: NDArray[np.intp]) -> PointClouds:
    """Select the points of each cloud with the indices `order`, [M] or [B, M]; cameras are unchanged."""
    return map_points(lambda a: a[np.arange(len(a))[:, None], order], clouds)


def assert_permutation_invariant(
    describe: Describe, clouds: PointClouds, seed: int, config: DescriptorConfig, drift: float | None = None
) -> None:
    """Assert that the order of the points, including padding, does not matter.

    Holds bit by bit for functions of aligned clouds: extremes are coordinates of points, and counts are integers below
    2^24, exact in any order. In view normalization the order of sums changes the last bits.
    """
    order = np.argsort(np.random.default_rng(seed).random(clouds.mask.shape), axis=1)
    assert_near(describe(taken(clouds, order)), describe(clouds), config, drift)


def assert_padding_invariant(
    describe: Describe, clouds: PointClouds, capacity: int, config: DescriptorConfig, drift: float = 0.0
) -> None:
    """Assert that the padded number of points does not matter, up to rounding.

    Another capacity is another compiled program, which may sum products in another order.

    Args:
        describe: function that also accepts the other capacity.
        clouds: any clouds.
        capacity: a capacity above that of `clouds`.
        config: config of the descriptor.
        drift: 0 for functions of aligned clouds.
    """
    padding = capacity - clouds.mask.shape[1]
    padded = map_points(lambda a: jnp.pad(a, [(0, 0), (0, padding)] + [(0, 0)] * (a.ndim - 2)), clouds)
    assert_near(describe(padded), describe(clouds), config, drift)


def assert_batch_size_invariant(
    describe: Describe, clouds: PointClouds, config: DescriptorConfig, drift: float = 0.0
) -> None:
    """Assert that the batch size does not matter, up to rounding: each cloud is described as if it were alone.

    Another batch size is another compiled program, which may sum products in another order.

    Args:
        describe: function that also accepts batches of one cloud.
        clouds: any clouds.
        config: config of the descriptor.
        drift: 0 for functions of aligned clouds.
    """
    alone = [describe(jax.tree.map(lambda a, b=b: a[b : b + 1], clouds)) for b in range(len(clouds.mask))]
    assert_near(jax.tree.map(lambda *fields: jnp.concatenate(fields), *alone), describe(clouds), config, drift)


def assert_company_invariant(describe: Describe, clouds: PointClouds, others: PointClouds) -> None:
    """Assert that a descriptor does not depend on the other clouds of the batch, bit by bit.

    Equal shapes mean the same program, in which nothing crosses the batch axis.
    """
    expected = describe(clouds)
    for b in range(clouds.mask.shape[0]):
        mixed = jax.tree.map(lambda one, other, b=b: other.at[b].set(one[b]), clouds, others)
        assert_equal(*(jax.tree.map(lambda a, b=b: a[b], d) for d in (describe(mixed), expected)))


def assert_rigid_motion_invariant(
    describe: Describe,
    clouds: PointClouds,
    rotation: NDArray[np.float64],
    shift: NDArray[np.float64],
    config: DescriptorConfig,
    drift: float,
) -> None:
    """Assert that a rigid motion of cloud and camera together changes nothing, up to the drift by rounding.

    Holds on `decided_clouds`. Where a choice is a tie, as between two boxes of equal volume, rounding decides it, and
    the frame may be another of the equal ones.

    Args:
        describe: function of camera clouds.
        clouds: `decided_clouds`.
        rotation: [3, 3].
        shift: [3] metres.
        config: config of the descriptor.
        drift: `alignment_drift` of the pose farther from the origin.
    """
    points, camera = (np.asarray(a, np.float64) @ rotation.T + shift for a in (clouds.points, clouds.camera))
    points = np.where(np.asarray(clouds.mask)[..., None], points, 0)
    moved = dataclasses.replace(
        clouds, points=jnp.asarray(points, jnp.float32), camera=jnp.asarray(camera, jnp.float32)
    )
    assert_near(describe(moved), describe(clouds), config, drift)


def assert_scale_invariant(
    describe_at: Callable[[PointClouds, float], Descriptors], clouds: PointClouds, sigma_s: float, exponent: int
) -> None:
    """Assert that an object k times as large, described with sigma_s / k, has the same descriptor.

    Holds bit by bit on every kind of cloud if k is a power of two.

    Args:
        describe_at: function of camera clouds and sigma_s.
        clouds: any clouds.
        sigma_s: scaled units per metre.
        exponent: binary logarithm of k.
    """
    k = 2.0**exponent
    larger = dataclasses.replace(clouds, points=clouds.points * k, camera=clouds.camera * k)
    assert_equal(describe_at(larger, sigma_s / k), describe_at(clouds, sigma_s))


def assert_duplicates_count_twice(
    describe: Describe, clouds: PointClouds, config: DescriptorConfig, drift: float | None = None
) -> None:
    """Assert that duplicating every point keeps the images and doubles the embeddings.

    Holds bit by bit for functions of aligned clouds: extremes stay, and doubled counts double every sum and product
    exactly. Overflow counts points as well as pairs, and is not compared.

    Args:
        describe: any function with the paper's convention; the released one divides by the number of points.
        clouds: at most half full.
        config: config of the descriptor.
        drift: drift of the alignment, if `describe` aligns.
    """
    half = np.arange(clouds.mask.shape[1] // 2)
    once, twice = describe(clouds), describe(taken(clouds, np.tile(half, 2)))
    halved = dataclasses.replace(twice, embeddings=twice.embeddings / 2, overflow=once.overflow)
    assert_near(halved, once, config, drift)


def assert_same_regions_alike(describe: Describe, clouds: PointClouds, network: ColorNetwork, seed: int) -> None:
    """Assert that colours of the same regions give equal descriptors, bit by bit.

    Every point gets another 8-bit colour that belongs to the same set of regions.
    """
    rng = np.random.default_rng(seed)
    _, of_color, counts = np.unique(network.region_bits, return_inverse=True, return_counts=True)
    by_set, first = np.argsort(of_color, kind="stable"), np.cumsum(counts) - counts
    region_set = of_color[grid_index(np.floor(np.asarray(clouds.colors) * 255 + 0.5).astype(np.uint8))]
    other = by_set[first[region_set] + (rng.random(region_set.shape) * counts[region_set]).astype(np.int64)]
    rgb = grid_colors()[other].astype(np.int64)
    # Every 8-bit colour within two steps of a grid colour has its regions.
    rgb = np.clip(rgb + rng.integers(-2, 3, rgb.shape), 0, 255)
    recolored = dataclasses.replace(clouds, colors=jnp.asarray(rgb, jnp.float32) / np.float32(255))
    assert_equal(describe(recolored), describe(clouds))


def assert_object_unity(describe: Describe, aligned: PointClouds, config: DescriptorConfig, m: int) -> None:
    """Assert that removing all points from slice m on does not change the blocks of the slices before, bit by bit.

    This is the paper's reason for slices: the visible part of an object is described as if all of it were visible.

    Args:
        describe: function of aligned clouds, with the paper's convention.
        aligned: clouds of `aligned_clouds`.
        config: config of the descriptor.
        m: first slice that is removed.
    """
    keep = aligned.mask & (np.asarray(aligned.points[..., 2]) < m * config.sigma_1)
    descriptors, expected = describe(dataclasses.replace(aligned, mask=keep)), describe(aligned)
    for name in ("images", "embeddings"):
        whole, cut = (np.asarray(getattr(d, name)) for d in (expected, descriptors))
        np.testing.assert_array_equal(cut[:, :m], whole[:, :m], err_msg=name)
        assert not cut[:, m:].any(), f"{name} of removed slices"


def reference_descriptor(
    points: NDArray[np.floating], rgb: NDArray[np.uint8], network: ColorNetwork, config: DescriptorConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], int]:
    """Compute the hard descriptor of one aligned cloud in NumPy and float64.

    Args:
        points: [n, 3], scaled units, first octant.
        rgb: [n, 3].
        network: the colour network.
        config: of either convention, without relaxation.

    Returns:
        Images [S, P, P]; embeddings [S, R, J]; the persistence [S, J] of each strip, 0 for empty ones; and the number
        of points outside plus the number of strips whose persistence exceeds the window.
    """
    x, y, z = points.astype(np.float64).T
    released = config.convention == "released"
    if released:
        x, y, z = np.round(x, 2), np.round(y, 2), np.round(z, 1)
        i, j = np.searchsorted(np.unique(z), z), np.digitize(x, np.arange(config.n_strips) * config.sigma_2, right=True)
    else:
        cells = (np.clip(np.floor(at / width), -1, 2**31) for at, width in ((z, config.sigma_1), (x, config.sigma_2)))
        i, j = (numbers.astype(np.intp) for numbers in cells)
    weights = network.membership(rgb).astype(np.float64)
    shape = (config.n_slices, config.n_strips)
    images = np.zeros((shape[0], config.image_size, config.image_size))
    embeddings = np.zeros((shape[0], network.n_regions, shape[1]))
    persistence, edges = np.zeros(shape), (np.arange(config.image_size + 1) - 1) * config.sigma_2
    inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
    for a, b in set(zip(i[inside].tolist(), j[inside].tolist(), strict=True)):
        here = (i == a) & (j == b)
        persistence[a, b] = np.ptp(y[here])
        centres = (b * config.sigma_2, persistence[a, b])
        births, deaths = (np.diff(ndtr((edges - centre) / np.sqrt(config.image_variance))) for centre in centres)
        images[a] += persistence[a, b] ** config.persistence_weight * np.outer(births, deaths)
        embeddings[a, :, b] = weights[here].sum(axis=0) / (here.sum() if released else 1) @ network.similarity
    overflow = int((~inside).sum()) + int((persistence > config.window).sum())
    return images, embeddings, persistence, overflow


def assert_follows_equations(
    describe: Describe, aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig
) -> None:
    """Assert that descriptors equal those of `reference_descriptor` up to rounding.

    Holds for every cloud in the released convention and for `aligned_clouds` in the paper's convention: a quotient
    rounded to float32 can cross the border of a strip. Coordinates below 2 add 2 units to the error of a persistence.

    Args:
        describe: function of aligned clouds.
        aligned: aligned clouds.
        network: the colour network.
        config: without relaxation.
    """
    descriptors = describe(aligned)
    for b, mask in enumerate(np.asarray(aligned.mask)):
        points, colors = (np.asarray(array[b])[mask] for array in (aligned.points, aligned.colors))
        rgb = np.floor(colors * 255 + 0.5).astype(np.uint8)
        images, embeddings, persistence, overflow = reference_descriptor(points, rgb, network, config)
        assert int(descriptors.overflow[b]) == overflow
        drift = 8 * UNIT * image_lipschitz(persistence, config).sum(axis=-1)
        bound = image_rounding(persistence.sum(axis=-1), config) + drift
        assert_within("images", descriptors.images[b], images, bound, summed=(-2, -1))
        bound = 2 * embedding_rounding(network.n_regions) * embeddings
        assert_within("embeddings", descriptors.embeddings[b], embeddings, bound)
