"""Looks: their order, geometry, colours and masks, against clouds that are changed and packed by NumPy; statistics."""

import dataclasses
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import assert_refused
from small_clouds import CLOSED, NETWORK

import thor2_jax as thor2
from colornet.colors import GRID_WHITE, to_lab
from thor2_jax.descriptor import describe, looks
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import aligned_looks, cloud_statistics, describe_looks, side_lengths

WARMER = np.array([1.06, 1, 1 / 1.06], np.float32)

Cloud = tuple[np.ndarray, np.ndarray]


def wedge(sides: tuple[float, float, float], seed: int = 0, n: int = 400) -> Cloud:
    """Points on a wedge, so that its ends differ, half a metre before the camera."""
    rng = np.random.default_rng(seed)
    points = rng.random((n, 3)) * sides
    points[:, 1] *= 1 - 0.3 * points[:, 0] / sides[0]
    corners = np.array([[0, 0, 0], [0, sides[1], 0], [sides[0], 0, 0], [sides[0], sides[1], sides[2]]])
    points = np.concatenate([points, corners]) + (0, 0, 0.5)
    return points.astype(np.float32), rng.integers(0, 256, points.shape, np.uint8)


LONG, SQUARE = wedge((0.2, 0.1, 0.06)), wedge((0.12, 0.115, 0.06), 1, n=395)  # 404 and 399 points
RIMS = [points[:, 1] > 0.07 for points, _ in (LONG, SQUARE)]
PACKED = thor2.PointClouds.pack([LONG, SQUARE], rim=RIMS)


def half_turned(cloud: Cloud) -> np.ndarray:
    """Return the points [n, 3] of a cloud that is packed alone and aligned after a half turn about z."""
    normal = thor2.mirror(thor2.view_normalize(thor2.PointClouds.pack([cloud]), CLOSED), "xy")
    return thor2.turn(normal, CLOSED).unpack()[0][0]


def test_the_second_of_two_looks_or_without_a_rim_is_a_half_turn() -> None:
    unknown, none = (thor2.PointClouds.pack([LONG, SQUARE], rim=rim) for rim in (None, [None, None]))
    assert unknown.rim is None and none.rim is not None
    for clouds, count in ((PACKED, 2), (unknown, 4), (none, 4)):
        seconds = aligned_looks(clouds, CLOSED, count).unpack()[1::count]
        for (points, colors), cloud in zip(seconds, (LONG, SQUARE), strict=True):
            np.testing.assert_allclose(points, half_turned(cloud), atol=2e-6)
            np.testing.assert_array_equal(colors, np.float32(cloud[1]) / np.float32(255))


def test_four_looks_are_those_of_changed_clouds() -> None:
    aligned = aligned_looks(PACKED, CLOSED, 4)
    np.testing.assert_allclose(aligned.camera[::4], thor2.align(PACKED, CLOSED).camera, atol=1e-6)
    for number, ((points, colors), rim) in enumerate(zip((LONG, SQUARE), RIMS, strict=True)):
        assert 0 < rim.sum() < len(rim) / 2
        given, shades = thor2.align(thor2.PointClouds.pack([(points, colors)]), CLOSED).unpack()[0][0], colors / 255
        expected = [
            (given, shades),
            (half_turned((points[~rim], colors[~rim])), shades[~rim]),
            (half_turned((points, colors)), (shades * WARMER).clip(0, 1)),
            (given, (shades / WARMER).clip(0, 1)),
        ]
        looks_at_cloud = aligned.unpack()[4 * number : 4 * number + 4]
        for actual, (places, tints) in zip(looks_at_cloud, expected, strict=True):
            np.testing.assert_allclose(actual[0], places, atol=5e-6)
            np.testing.assert_allclose(actual[1], tints, atol=1e-6)


def test_tiny_clouds_have_finite_looks() -> None:
    for n in (0, 1, 3):
        tiny = thor2.PointClouds.pack([(LONG[0][:n], LONG[1][:n])] * 2, rim=[np.zeros(n, bool), np.ones(n, bool)])
        described, aligned = describe_looks(tiny, NETWORK, CLOSED, 4), aligned_looks(tiny, CLOSED, 4)
        assert np.asarray(aligned.mask).sum(axis=1).tolist() == [n, n, n, n, n, 0, n, n]
        assert all(np.isfinite(values).all() for values in jax.tree.leaves((described, aligned)))


def test_other_counts_are_refused() -> None:
    for count in (0, 3, 5):
        assert_refused(f"count is {count}", aligned_looks, PACKED, CLOSED, count)
        assert_refused(f"count is {count}", describe_looks, PACKED, NETWORK, CLOSED, count)


@pytest.mark.parametrize(("backend", "calls"), [("cpu", 2), ("gpu", 1)])
def test_chunks_have_the_descriptors_of_the_batch(backend: str, calls: int, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, recorded = describe_looks(PACKED, NETWORK, CLOSED, 4), Mock(wraps=aligned_looks)
    monkeypatch.setattr(describe, "MAX_LARGE_CHUNK_POINTS", 4 * PACKED.mask.shape[1])
    monkeypatch.setattr(looks, "aligned_looks", recorded)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    chunked = describe_looks(PACKED, NETWORK, CLOSED, 4)
    assert recorded.call_count == calls
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), chunked, whole)


def test_an_occluded_end_decides_the_half_turn() -> None:
    x = np.asarray(thor2.view_normalize(PACKED, CLOSED).points)[0, :, 0]
    boundary = np.zeros(PACKED.mask.shape, bool)
    boundary[0] = np.asarray(PACKED.mask)[0] & (x > x.max() - 0.01)
    aligned = aligned_looks(dataclasses.replace(PACKED, boundary=jnp.asarray(boundary)), CLOSED, 2)
    np.testing.assert_array_equal(aligned.points[1], aligned.points[0])
    assert np.abs(aligned.points[3] - aligned.points[2]).max() > 0.01


def test_descriptors_and_statistics_are_those_of_each_look() -> None:
    described = describe_looks(PACKED, NETWORK, CLOSED, 4)
    aligned = aligned_looks(PACKED, CLOSED, 4)
    assert described.statistics.shape[:2] == described.shape == (2, 4)
    np.testing.assert_allclose(described.first.tops2, thor2.describe(PACKED, NETWORK, CLOSED).tops2, atol=1e-4)
    for row, cloud in enumerate(aligned.unpack()):
        alone = thor2.PointClouds.pack([cloud])  # points of the rim are not there, instead of masked
        descriptors = jax.tree.map(lambda a, row=row: a[row // 4, row % 4], described.each)
        expected = thor2.describe_aligned(alone, NETWORK, CLOSED)
        np.testing.assert_allclose(descriptors.tops2, expected.tops2[0], atol=1e-4)
        statistics = cloud_statistics(side_lengths(alone, CLOSED.alpha), alone, strips(alone, NETWORK, CLOSED))[0]
        np.testing.assert_allclose(described.statistics[row // 4, row % 4], statistics, atol=1e-4)
    assert np.abs(described.statistics[:, 2] - described.statistics[:, 3]).max() > 1e-3


def test_overflow_is_that_of_the_first_look() -> None:
    short = dataclasses.replace(CLOSED, n_slices=2)
    described = describe_looks(PACKED, NETWORK, short, 4)
    np.testing.assert_array_equal(described.overflow, thor2.describe(PACKED, NETWORK, short).overflow)
    assert np.asarray(described.overflow).min() > 0
    assert (np.asarray(described.each.overflow)[:, 1] != np.asarray(described.overflow)).any()


def test_fused_probabilities_are_geometric_means() -> None:
    logits = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    odds = np.exp(logits.astype(np.float64))
    means = np.prod((odds / odds.sum(axis=1, keepdims=True)).reshape(2, 4, 3), axis=1) ** 0.25
    fused = describe_looks(PACKED, NETWORK, CLOSED, 4).fuse(jnp.asarray(logits))
    np.testing.assert_allclose(fused, means / means.sum(axis=1, keepdims=True), rtol=1e-5)


def test_statistics_of_a_cloud() -> None:
    colors = LONG[1]
    aligned = thor2.align(thor2.PointClouds.pack([LONG]), CLOSED)
    described = strips(aligned, NETWORK, CLOSED)
    values = np.asarray(cloud_statistics(jnp.asarray([[0.5, 0.25, 0.125]]), aligned, described))[0]
    scalars = [1, 0.5, 0.25, 0.75, np.sqrt(404) / 20, *colors.mean(axis=0) / 255, *colors.std(axis=0) / 255, 0.5]
    region_points = np.asarray(described.color).sum(axis=(0, 1, 2))
    expected = [*scalars, *np.sqrt(region_points / region_points.sum())]
    assert len(scalars) == looks.N_SCALARS
    np.testing.assert_allclose(values, expected, atol=1e-4)


def test_balanced_histograms_are_those_of_colour_science() -> None:
    rng = np.random.default_rng(0)
    colors = rng.random((200, 3)) * (0.9, 0.6, 0.3)
    mask = rng.random(200) < 0.7
    weight = mask / mask.sum()
    lab = to_lab(255 * (colors * np.sqrt(0.45 / (weight @ colors + 0.03))).clip(0, 1), GRID_WHITE)
    place = np.column_stack([lab[:, 0] / 20, 3 + 3 * np.arcsinh(lab[:, 1:] / 10) / np.arcsinh(6)]).clip(0, (5, 6, 6))
    expected = np.zeros((6, 7, 7))
    for point, share in zip(place, weight, strict=True):
        low = np.minimum(point.astype(int), (4, 5, 5))
        for corner in np.ndindex(2, 2, 2):
            expected[tuple(low + corner)] += share * np.abs(1 - np.array(corner) - (point - low)).prod()
    actual = looks.balanced_histogram(jnp.asarray(colors, jnp.float32)[None], jnp.asarray(mask)[None])
    assert actual.shape == (1, looks.N_BALANCED)
    np.testing.assert_allclose(np.square(actual[0]), expected.ravel(), atol=1e-3)


def test_side_lengths_are_those_before_the_turn() -> None:
    extents = np.ptp(thor2.view_normalize(PACKED, CLOSED).points, axis=1)  # padding lies in a corner of the box
    sides = side_lengths(thor2.align(PACKED, CLOSED), CLOSED.alpha)
    np.testing.assert_allclose(sides, np.sort(extents)[:, ::-1], atol=1e-4)


def test_statistics_of_one_color_have_gradients() -> None:
    clouds = thor2.PointClouds.pack([(np.random.default_rng(0).random((50, 3)), np.full((50, 3), 90, np.uint8))])
    described = strips(thor2.align(clouds, CLOSED), NETWORK, CLOSED)

    def total(colors: jax.Array, vectors: jax.Array) -> jax.Array:
        changed = dataclasses.replace(clouds, colors=colors), dataclasses.replace(described, color=vectors)
        return cloud_statistics(jnp.ones((1, 3)), *changed).sum()

    assert not np.asarray(described.color).sum(axis=(0, 1, 2)).all()  # most colour regions have no point
    of_colors, of_vectors = jax.grad(total, (0, 1))(clouds.colors, described.color)
    assert np.isfinite(of_colors).all() and np.asarray(of_colors).any() and np.isfinite(of_vectors).all()
