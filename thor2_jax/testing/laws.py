"""What must not change a descriptor, one assertion a law, for any function from clouds to descriptors.

    @given(packed(aligned_clouds(config), size=4, capacity=512), seeds())
    def test_order(clouds, seed):
        assert_permutation_invariant(my_descriptor, clouds, seed)

Each law says whether it holds bit by bit. If not, it takes a `drift`: how far rounding may move an aligned point
(`alignment_drift`); the bounds on images and embeddings follow from that (`assert_near`). `drift=None`, the default, is
for what begins at aligned clouds, and asks for the same bits.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import OCCLUSION_BIN
from thor2_jax.testing.clouds import settled
from thor2_jax.testing.comparing import assert_equal, assert_near, joined, taken, with_points
from thor2_jax.testing.tolerances import UNIT
from thor2_jax.types import Descriptors, PointClouds, Strips

__all__ = [
    "assert_backends_agree",
    "assert_batch_size_invariant",
    "assert_company_invariant",
    "assert_duplicates_count_twice",
    "assert_flip_follows_rule",
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


def _compare(found: Descriptors, expected: Descriptors, config: DescriptorConfig, drift: float | None) -> None:
    if drift is None:
        assert_equal(found, expected)
    else:
        assert_near(found, expected, config, drift)


def assert_permutation_invariant(
    describe: Describe, clouds: PointClouds, seed: int, config: DescriptorConfig, drift: float | None = None
) -> None:
    """A cloud is a set: the order of its points, padding among them included, means nothing.

    Bit by bit from aligned clouds on: extremes are some points' own coordinates, and counts are whole numbers below
    2^24, exact in any order. View normalization sums coordinates and products, in an order that does matter to the last
    bits.
    """
    size = clouds.mask.shape
    order = np.argsort(np.random.default_rng(seed).random(size), axis=1)
    _compare(describe(taken(clouds, order)), describe(clouds), config, drift)


def assert_padding_invariant(
    describe: Describe, clouds: PointClouds, capacity: int, config: DescriptorConfig, drift: float = 0.0
) -> None:
    """The bucket that a cloud is padded to means nothing.

    Another bucket is another program: products may be summed in another order, so this holds up to rounding.

    Args:
        describe: compiles for the other capacity.
        clouds: any.
        capacity: more than that of `clouds`.
        config: of the descriptor.
        drift: 0 from aligned clouds on.
    """
    missing = capacity - clouds.mask.shape[1]
    padded = {
        name: jnp.pad(getattr(clouds, name), [(0, 0), (0, missing)] + [(0, 0)] * (getattr(clouds, name).ndim - 2))
        for name in ("points", "colors", "mask", "boundary")
    }
    assert_near(describe(dataclasses.replace(clouds, **padded)), describe(clouds), config, drift)


def assert_batch_size_invariant(
    describe: Describe, clouds: PointClouds, config: DescriptorConfig, drift: float = 0.0
) -> None:
    """The size of the batch means nothing: each cloud is described as if it were alone.

    A batch of another size is another program: this holds up to rounding, as `assert_padding_invariant` does.

    Args:
        describe: compiles for batches of one.
        clouds: any.
        config: of the descriptor.
        drift: 0 from aligned clouds on.
    """
    alone = [describe(jax.tree.map(lambda a, b=b: a[b : b + 1], clouds)) for b in range(len(clouds.mask))]
    assert_near(jax.tree.map(lambda *parts: jnp.concatenate(parts), *alone), describe(clouds), config, drift)


def assert_company_invariant(describe: Describe, clouds: PointClouds, others: PointClouds) -> None:
    """A cloud's descriptor does not depend on the clouds beside it in the batch, whatever these are.

    Bit by bit: the shapes are the same, so the program is, and nothing in it crosses the batch axis.
    """
    expected = describe(clouds)
    for b in range(clouds.mask.shape[0]):
        mixed = jax.tree.map(lambda mine, other, b=b: other.at[b].set(mine[b]), clouds, others)
        found = describe(mixed)
        assert_equal(*(jax.tree.map(lambda a, b=b: a[b], d) for d in (found, expected)))


def assert_translation_invariant(describe: Describe, clouds: PointClouds, shift: ArrayLike) -> None:
    """Cloud and camera moved together by a shift: nothing changes.

    Bit by bit on `lattice_clouds` shifted by whole steps of theirs, up to 1 m: their mean is exact, and so is what is
    left when it is taken away. So this is a law for every kind of cloud, balls and cubes too.

    Args:
        describe: from camera clouds.
        clouds: on the lattice.
        shift: [3] metres, a multiple of the lattice's step.
    """
    moved = with_points(clouds, np.asarray(clouds.points) + np.asarray(shift, np.float32))
    moved = dataclasses.replace(moved, camera=clouds.camera + jnp.asarray(shift, jnp.float32))
    assert_equal(describe(moved), describe(clouds))


def assert_rigid_motion_invariant(
    describe: Describe,
    clouds: PointClouds,
    rotation: NDArray[np.float64],
    shift: ArrayLike,
    config: DescriptorConfig,
    drift: float,
) -> None:
    """Cloud and camera turned and moved together: nothing changes, wherever the object stands.

    On `decided_clouds`, up to the drift by rounding. Where a choice is a tie - which of two boxes as small, which end
    has more of the cloud - rounding makes it, and the frame is another of the equal ones.

    Args:
        describe: from camera clouds.
        clouds: decided ones.
        rotation: [3, 3].
        shift: [3] metres.
        config: of the descriptor.
        drift: `alignment_drift` of the placement farther away.
    """
    points = np.asarray(clouds.points, np.float64) @ rotation.T + np.asarray(shift)
    camera = np.asarray(clouds.camera, np.float64) @ rotation.T + np.asarray(shift)
    moved = dataclasses.replace(with_points(clouds, points), camera=jnp.asarray(camera, jnp.float32))
    assert_near(describe(moved), describe(clouds), config, drift)


def assert_scale_invariant(
    describe_at: Callable[[PointClouds, float], Descriptors], clouds: PointClouds, sigma_s: float, exponent: int
) -> None:
    """Lengths come in scaled units: an object k times as large at sigma_s / k is the same object.

    Bit by bit for k a power of two, which is exact, on every kind of cloud.

    Args:
        describe_at: from camera clouds and sigma_s.
        clouds: any.
        sigma_s: scaled units a metre.
        exponent: k is two to the power of it.
    """
    k = 2.0**exponent
    larger = dataclasses.replace(clouds, points=clouds.points * k, camera=clouds.camera * k)
    assert_equal(describe_at(larger, sigma_s / k), describe_at(clouds, sigma_s))


def assert_duplicates_count_twice(
    describe: Describe, clouds: PointClouds, config: DescriptorConfig, drift: float | None = None
) -> None:
    """Every point twice: the shape is the same, and there is twice as much of each colour.

    Bit by bit from aligned clouds on: extremes stay, and doubled counts double every sum and product exactly. Overflow
    counts points and, apart from them, pairs past the window, so it is compared by `assert_overflow_told` alone.

    Args:
        describe: any; by the paper's convention (the released one divides counts by themselves).
        clouds: at most half full.
        config: of the descriptor.
        drift: of the alignment, if `describe` aligns.
    """
    half = clouds.mask.shape[1] // 2
    if np.asarray(clouds.mask[:, half:]).any():
        raise ValueError(f"clouds have points past half of the capacity, {half}")
    first = taken(clouds, np.arange(half))
    once, twice = describe(clouds), describe(joined(first, first))
    halved = dataclasses.replace(twice, embeddings=twice.embeddings / 2, overflow=once.overflow)
    _compare(halved, once, config, drift)


def assert_backends_agree(first: Describe, second: Describe, clouds: PointClouds) -> None:
    """The pairs in closed form are those of gudhi, on every input.

    Bit by bit: gudhi gives indices, and both take the same values from there. (Inside one larger program, compilers
    may fuse differently around the callback; compare the stages, not the whole, there.)
    """
    assert_equal(second(clouds), first(clouds))


def assert_same_regions_alike(describe: Describe, clouds: PointClouds, network: ColorNetwork, seed: int) -> None:
    """Colours of the same regions are indistinguishable: only regions enter a descriptor.

    Every point gets another 8-bit colour that belongs to the same set of regions. Bit by bit.
    """
    rng = np.random.default_rng(seed)
    _, of_color, counts = np.unique(network.region_bits, return_inverse=True, return_counts=True)
    by_set, first = np.argsort(of_color, kind="stable"), np.cumsum(counts) - counts
    levels = (np.floor(np.asarray(clouds.colors) * 255 + 0.5).astype(np.int64) + 2) // 5
    found = of_color[(levels[..., 0] * 52 + levels[..., 1]) * 52 + levels[..., 2]]
    other = by_set[first[found] + (rng.random(found.shape) * counts[found]).astype(np.int64)]
    rgb = np.stack([other // 52**2, other // 52 % 52, other % 52], axis=-1) * 5
    # Any 8-bit colour within two steps of the grid's has the grid's regions.
    rgb = np.clip(rgb + rng.integers(-2, 3, rgb.shape), 0, 255)
    recolored = dataclasses.replace(clouds, colors=jnp.asarray(rgb, jnp.float32) / np.float32(255))
    assert_equal(describe(recolored), describe(clouds))


def assert_object_unity(describe: Describe, aligned: PointClouds, config: DescriptorConfig, m: int) -> None:
    """Cutting away everything from slice m on leaves the blocks of the slices before m as they were.

    The paper's reason for slices: what is still to be seen of an object is described as if all of it were. Bit by bit.

    Args:
        describe: from aligned clouds, by the paper's convention.
        aligned: `settled` clouds.
        config: of the descriptor.
        m: first slice that is cut away.
    """
    keep = aligned.mask & (np.asarray(aligned.points[..., 2]) < m * config.sigma_1)
    found, expected = describe(dataclasses.replace(aligned, mask=keep)), describe(aligned)
    for name in ("images", "embeddings"):
        whole, cut = (np.asarray(getattr(d, name)) for d in (expected, found))
        np.testing.assert_array_equal(cut[:, :m], whole[:, :m], err_msg=name)
        assert not cut[:, m:].any(), f"{name} of slices that are cut away"


def assert_flip_follows_rule(
    normalize: Callable[[PointClouds], PointClouds], clouds: PointClouds, seed: int
) -> NDArray[np.int64]:
    """A hidden end turns the cloud by pi about z exactly when the first two x-bins hold more of the boundary.

    The rule is counted in NumPy on the cloud normalized without a boundary. Turned, it is that cloud mirrored in x and
    y, up to rounding: 8 u of the box's sides. Points are marked on both ends, none within 1e-4 of a bin's border;
    clouds whose last bin is in doubt by as little are left out.

    Args:
        normalize: `view_normalize` with a config.
        clouds: without boundary, any kind.
        seed: of the marks.

    Returns:
        [B]: 1 flipped, 0 not flipped, -1 left out.
    """
    rng = np.random.default_rng(seed)
    normal = normalize(clouds)
    points, mask = np.asarray(normal.points, np.float64), np.asarray(normal.mask)
    x = points[..., 0] / OCCLUSION_BIN
    last = np.floor(x.max(axis=1, initial=0))
    clear = np.abs(x - np.round(x)) > 1e-4 / OCCLUSION_BIN
    end = np.where(rng.random((len(mask), 1)) < 0.5, x <= 2, x >= last[:, None] - 1)
    marks = mask & clear & (end | (rng.random(mask.shape) < 0.1)) & (rng.random(mask.shape) < 0.7)
    bins = np.floor(x)
    flips = (marks & (bins <= 1)).sum(axis=1) > (marks & (bins >= last[:, None] - 1)).sum(axis=1)
    found = normalize(dataclasses.replace(clouds, boundary=jnp.asarray(marks)))
    sides = points.max(axis=1, keepdims=True)
    turned = np.where(mask[..., None], sides * [1, 1, 0] - points * [1, 1, -1], 0)
    longest = x.max(axis=1)
    doubtful = (longest > 0.5) & (np.abs(longest - np.round(longest)) <= 1e-4 / OCCLUSION_BIN)
    for b in np.flatnonzero(~doubtful):
        expected = turned[b] if flips[b] else points[b]
        np.testing.assert_allclose(found.points[b], expected, rtol=0, atol=8 * UNIT * float(sides[b].max()))
    return np.where(doubtful, -1, flips)


def assert_mirrored_strips(
    strips: Callable[[PointClouds], Strips], aligned: PointClouds, config: DescriptorConfig, axis: str
) -> None:
    """A mirrored cloud has mirrored strips: in x their order, in z that of the slices, in y low and high change places.

    Mirrored in x and z about the middle of the strips and slices that there are. Bit by bit but for y, whose extremes
    are rounded once on the way and once back: 2 u of the cloud's height.

    Args:
        strips: from aligned clouds.
        aligned: clouds within the slices and strips.
        config: of the descriptor, the paper's convention.
        axis: "x", "y" or "z".
    """
    k = "xyz".index(axis)
    points = np.asarray(aligned.points, np.float64)
    mask = np.asarray(aligned.mask)[..., None]
    # What touches the border at 0 would fall on the one past the last: settled, like the rest.
    spread = np.stack([settled(p + [1e-9, 0, 1e-9], config) for p in points])
    height = float(np.where(mask, points, 0).max(initial=0))
    size = (config.n_strips * config.sigma_2, height, config.n_slices * config.sigma_1)[k]
    plain = strips(with_points(aligned, spread))
    flipped = spread.copy()
    flipped[..., k] = size - spread[..., k]
    found = strips(with_points(aligned, flipped))
    expected = dataclasses.replace(plain)
    if axis == "y":
        occupied = np.asarray(plain.occupied)
        low, high = (np.where(occupied, size - np.asarray(a, np.float64), 0) for a in (plain.high, plain.low))
    else:
        order = (lambda a: a[:, :, ::-1]) if axis == "x" else (lambda a: a[:, ::-1])
        low, high = order(plain.low), order(plain.high)
        expected = dataclasses.replace(plain, occupied=order(plain.occupied), color=order(plain.color))
    np.testing.assert_array_equal(found.occupied, expected.occupied)
    np.testing.assert_array_equal(found.color, expected.color)
    np.testing.assert_array_equal(found.overflow, expected.overflow)
    atol = 2 * UNIT * size if axis == "y" else 0
    np.testing.assert_allclose(found.low, low, rtol=0, atol=atol)
    np.testing.assert_allclose(found.high, high, rtol=0, atol=atol)
