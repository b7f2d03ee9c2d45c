"""Invariances of descriptors and of instance clouds, with one assertion each, for any function that computes them.

    @settings(deadline=None)
    @given(packed(aligned_clouds(config), size=4, capacity=512), seeds())
    def test_order(clouds, seed):
        assert_permutation_invariant(my_descriptor, clouds, seed, config)

Each docstring states whether the property holds bit by bit. Otherwise the assertion takes a `drift`, the distance by
which rounding may move an aligned point (`alignment_drift`), from which the bounds on images and embeddings follow
(`assert_near`). The default `drift=None`, for functions of aligned clouds, requires equal bits.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from colornet import ColorNetwork, grid_index
from colornet.colors import grid_colors
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import OCCLUSION_BIN
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.testing.comparing import UNIT, assert_equal, assert_near, joined, map_points, taken, with_points
from thor2_jax.testing.strategies import settled
from thor2_jax.types import Descriptors, PointClouds, Strips

__all__ = [
    "assert_backends_agree",
    "assert_batch_size_invariant",
    "assert_company_invariant",
    "assert_depth_units_agree",
    "assert_duplicates_count_twice",
    "assert_flip_follows_rule",
    "assert_labels_are_names",
    "assert_mirrored_strips",
    "assert_object_unity",
    "assert_padding_invariant",
    "assert_permutation_invariant",
    "assert_rigid_motion_invariant",
    "assert_same_regions_alike",
    "assert_scale_invariant",
    "assert_translation_invariant",
]

Describe = Callable[[PointClouds], Descriptors]
InstanceClouds = Callable[[RGBDFrame], Sequence[PreparedInstance]]


def assert_permutation_invariant(
    describe: Describe, clouds: PointClouds, seed: int, config: DescriptorConfig, drift: float | None = None
) -> None:
    """Assert that the order of the points, including padding, does not matter.

    This holds bit by bit for functions of aligned clouds: extremes are coordinates of points, and counts are integers
    below 2^24, which are exact in any order. In view normalization, the order of sums changes the last bits.
    """
    order = np.argsort(np.random.default_rng(seed).random(clouds.mask.shape), axis=1)
    assert_near(describe(taken(clouds, order)), describe(clouds), config, drift)


def assert_padding_invariant(
    describe: Describe, clouds: PointClouds, capacity: int, config: DescriptorConfig, drift: float = 0.0
) -> None:
    """Assert that the padded number of points does not matter, up to rounding.

    Another capacity needs another compiled program, which may sum products in another order.

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
    """Assert that the batch size does not matter, up to rounding: each cloud has the same descriptor as alone.

    Another batch size needs another compiled program, which may sum products in another order.

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

    Equal shapes use the same program, in which clouds do not interact.
    """
    expected = describe(clouds)
    for b in range(clouds.mask.shape[0]):
        mixed = jax.tree.map(lambda one, other, b=b: jnp.asarray(other).at[b].set(one[b]), clouds, others)
        assert_equal(*(jax.tree.map(lambda a, b=b: a[b], d) for d in (describe(mixed), expected)))


def _moved(clouds: PointClouds, rotation: NDArray[np.float64], shift: ArrayLike) -> PointClouds:
    """Return clouds and cameras after a rotation [3, 3] and a shift [3] in float64, rounded to float32."""
    places = (np.asarray(array, np.float64) for array in (clouds.points, clouds.camera))
    points, camera = (place @ rotation.T + np.asarray(shift) for place in places)
    return dataclasses.replace(with_points(clouds, points), camera=jnp.asarray(camera, jnp.float32))


def assert_translation_invariant(describe: Describe, clouds: PointClouds, shift: ArrayLike) -> None:
    """Assert that a translation of cloud and camera together changes nothing.

    This holds bit by bit on `lattice_clouds` that are shifted by multiples of their step, up to 1 m, since their mean
    and centred coordinates are exact. It therefore holds for every kind of cloud, including balls and cubes.

    Args:
        describe: function of camera clouds.
        clouds: `lattice_clouds`.
        shift: [3] metres, a multiple of `LATTICE`.
    """
    assert_equal(describe(_moved(clouds, np.eye(3), shift)), describe(clouds))


def assert_rigid_motion_invariant(
    describe: Describe,
    clouds: PointClouds,
    rotation: NDArray[np.float64],
    shift: ArrayLike,
    config: DescriptorConfig,
    drift: float,
) -> None:
    """Assert that a rigid motion of cloud and camera together changes nothing, up to the drift by rounding.

    This holds on `decided_clouds`. On other clouds, rounding decides ties, for example between two boxes of equal
    volume, so the frame may be another one.

    Args:
        describe: function of camera clouds.
        clouds: `decided_clouds`.
        rotation: [3, 3].
        shift: [3] metres.
        config: config of the descriptor.
        drift: `alignment_drift` of the pose farther from the origin.
    """
    assert_near(describe(_moved(clouds, rotation, shift)), describe(clouds), config, drift)


def assert_scale_invariant(
    describe_at: Callable[[PointClouds, float], Descriptors], clouds: PointClouds, sigma_s: float, exponent: int
) -> None:
    """Assert that an object k times as large, described with sigma_s / k, has the same descriptor.

    This holds bit by bit on every kind of cloud if k is a power of two.

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

    This holds bit by bit for functions of aligned clouds: extremes do not change, and doubled counts double every sum
    and product exactly. Overflow counts points as well as pairs and is checked by `assert_overflow_told`.

    Args:
        describe: function with the paper's convention; the released convention divides by the number of points.
        clouds: clouds that are at most half full.
        config: config of the descriptor.
        drift: drift of the alignment, if `describe` aligns.
    """
    half = clouds.mask.shape[1] // 2
    if np.asarray(clouds.mask[:, half:]).any():
        raise ValueError(
            f"clouds has points beyond half of the capacity, {half}; expected clouds that are at most half full"
        )
    first = taken(clouds, np.arange(half))
    once, twice = describe(clouds), describe(joined(first, first))
    halved = dataclasses.replace(twice, embeddings=twice.embeddings / 2, overflow=once.overflow)
    assert_near(halved, once, config, drift)


def assert_backends_agree(first: Describe, second: Describe, clouds: PointClouds) -> None:
    """Assert that the closed form and gudhi give equal descriptors on every input, bit by bit.

    gudhi returns indices, by which both gather the same values. In a larger program, XLA may fuse operations around the
    callback differently; compare the stages separately in this case.
    """
    assert_equal(second(clouds), first(clouds))


def assert_same_regions_alike(describe: Describe, clouds: PointClouds, network: ColorNetwork, seed: int) -> None:
    """Assert that colours of the same regions give equal descriptors, bit by bit.

    Every point gets another 8-bit colour that belongs to the same set of regions.
    """
    rng = np.random.default_rng(seed)
    _, of_color, counts = np.unique(network.region_bits, return_inverse=True, return_counts=True)
    by_set, first = np.argsort(of_color, kind="stable"), np.cumsum(counts) - counts
    region_set = of_color[grid_index(np.floor(np.asarray(clouds.colors) * 255 + 0.5).astype(np.uint8))]
    other = by_set[first[region_set] + (rng.random(region_set.shape) * counts[region_set]).astype(np.int64)]
    rgb = grid_colors()[other]
    # Every 8-bit colour within two steps of a grid colour has its regions.
    rgb = np.clip(rgb + rng.integers(-2, 3, rgb.shape), 0, 255)
    recolored = dataclasses.replace(clouds, colors=jnp.asarray(rgb, jnp.float32) / np.float32(255))
    assert_equal(describe(recolored), describe(clouds))


def assert_object_unity(describe: Describe, aligned: PointClouds, config: DescriptorConfig, m: int) -> None:
    """Assert that removing all points from slice m on does not change the blocks of earlier slices, bit by bit.

    This is the paper's reason for slices: the visible part has the same description as in an unoccluded object.

    Args:
        describe: function of aligned clouds, with the paper's convention.
        aligned: `settled` clouds.
        config: config of the descriptor.
        m: first slice that is removed.
    """
    keep = aligned.mask & (np.asarray(aligned.points[..., 2]) < m * config.sigma_1)
    descriptors, expected = describe(dataclasses.replace(aligned, mask=keep)), describe(aligned)
    for name in ("images", "embeddings"):
        whole, cut = (np.asarray(getattr(d, name)) for d in (expected, descriptors))
        np.testing.assert_array_equal(cut[:, :m], whole[:, :m], err_msg=name)
        assert not cut[:, m:].any(), f"{name} of removed slices"


def assert_flip_follows_rule(
    normalize: Callable[[PointClouds], PointClouds], clouds: PointClouds, seed: int
) -> NDArray[np.int64]:
    """Assert that a cloud is rotated by pi about z exactly if its first two x-bins contain more boundary points.

    The points are counted in NumPy on the cloud that is normalized without a boundary. The rotated cloud equals that
    cloud mirrored in x and y, up to rounding by 8 units of the sides of the box. Boundary points are drawn at both
    ends, at least 1e-4 away from the borders of bins; clouds whose last bin is ambiguous by less are skipped.

    Args:
        normalize: `view_normalize` with a config.
        clouds: any clouds without a boundary.
        seed: seed for the boundary points.

    Returns:
        [B]: 1 flipped, 0 not flipped, -1 skipped.
    """
    rng = np.random.default_rng(seed)
    normal = normalize(clouds)
    points, mask = np.asarray(normal.points, np.float64), np.asarray(normal.mask)
    x = points[..., 0] / OCCLUSION_BIN
    last = np.floor(x.max(axis=1, initial=0))
    clear = np.abs(x - np.round(x)) > 1e-4 / OCCLUSION_BIN
    end = np.where(rng.random((len(mask), 1)) < 0.5, x <= 2, x >= last[:, None] - 1)
    boundary = mask & clear & (end | (rng.random(mask.shape) < 0.1)) & (rng.random(mask.shape) < 0.7)
    bins = np.floor(x)
    flips = (boundary & (bins <= 1)).sum(axis=1) > (boundary & (bins >= last[:, None] - 1)).sum(axis=1)
    with_boundary = normalize(dataclasses.replace(clouds, boundary=jnp.asarray(boundary)))
    sides = points.max(axis=1, keepdims=True)
    turned = np.where(mask[..., None], sides * [1, 1, 0] - points * [1, 1, -1], 0)
    longest = x.max(axis=1)
    ambiguous = (longest > 0.5) & (np.abs(longest - np.round(longest)) <= 1e-4 / OCCLUSION_BIN)
    for b in np.flatnonzero(~ambiguous):
        expected = turned[b] if flips[b] else points[b]
        np.testing.assert_allclose(with_boundary.points[b], expected, rtol=0, atol=8 * UNIT * float(sides[b].max()))
    return np.where(ambiguous, -1, flips)


def assert_mirrored_strips(
    strips: Callable[[PointClouds], Strips], aligned: PointClouds, config: DescriptorConfig, axis: str
) -> None:
    """Assert that mirroring reverses the strips (x) or the slices (z), or exchanges low and high (y).

    Clouds are mirrored in x and z about the middle of the grid of slices and strips. This holds bit by bit except for
    y, whose extremes are rounded twice, by 2 units of the height of the cloud.

    Args:
        strips: function of aligned clouds.
        aligned: clouds within the grid of slices and strips.
        config: config of the descriptor, with the paper's convention.
        axis: "x", "y" or "z".
    """
    k = "xyz".index(axis)
    points = np.asarray(aligned.points, np.float64)
    mask = np.asarray(aligned.mask)[..., None]
    # Points on the border at 0 would leave the grid when mirrored, so they are settled like the others.
    spread = np.stack([settled(p + [1e-9, 0, 1e-9], config) for p in points])
    height = float(np.where(mask, points, 0).max(initial=0))
    size = (config.n_strips * config.sigma_2, height, config.n_slices * config.sigma_1)[k]
    plain = strips(with_points(aligned, spread))
    flipped = spread.copy()
    flipped[..., k] = size - spread[..., k]
    mirrored = strips(with_points(aligned, flipped))
    if axis == "y":
        low, high = (np.where(plain.occupied, size - np.asarray(a, np.float64), 0) for a in (plain.high, plain.low))
        expected, rounding = vars(plain) | {"low": low, "high": high}, 2 * UNIT * size
    else:
        reversed_axis, rounding = 2 if axis == "x" else 1, 0.0
        expected = vars(jax.tree.map(lambda a: np.flip(a, reversed_axis) if a.ndim > 1 else a, plain))
    for name, values in expected.items():
        atol = rounding if name in ("low", "high") else 0
        np.testing.assert_allclose(getattr(mirrored, name), values, rtol=0, atol=atol, err_msg=name)


def assert_labels_are_names(instance_clouds: InstanceClouds, frame: RGBDFrame, seed: int) -> None:
    """Assert that other label numbers give the same clouds, bit by bit."""
    numbers = np.random.default_rng(seed).choice(np.arange(1, 2**16, dtype=np.uint16), len(frame.instances), False)
    other = dict(zip(frame.instances, numbers.tolist(), strict=True))
    labels = np.zeros(frame.label_image.shape, np.uint16)
    for label, pixels in frame.instance_pixels.items():
        labels.flat[pixels] = other[label]
    clouds = {c.label: c for c in instance_clouds(dataclasses.replace(frame, labels=labels))}
    expected = list(instance_clouds(frame))
    _assert_equal_clouds([clouds.pop(other[cloud.label]) for cloud in expected], expected)
    assert not clouds


def assert_depth_units_agree(instance_clouds: InstanceClouds, frame: RGBDFrame) -> None:
    """Assert that depth in integer units and in metres gives the same clouds, bit by bit."""
    _assert_equal_clouds(instance_clouds(dataclasses.replace(frame, depth=frame.depth_m)), instance_clouds(frame))


def _assert_equal_clouds(actual: Sequence[PreparedInstance], expected: Sequence[PreparedInstance]) -> None:
    for first, second in zip(actual, expected, strict=True):
        for name in sorted(vars(first).keys() - {"label"}):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
