"""Candidate orientations: their order, their geometry and their number."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import colornet
import thor2_jax as thor2
from thor2_jax.config import ORIENTATION_COUNTS
from thor2_jax.descriptor import chunking, orientations
from thor2_jax.descriptor.orientations import candidate_orientations, describe_orientations

CONFIG = thor2.DescriptorConfig(homology="closed_form")


def box(sides: tuple[float, float, float], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on a wedge, so that its ends differ, half a metre before the camera."""
    rng = np.random.default_rng(seed)
    points = rng.random((400, 3)) * sides
    points[:, 1] *= 1 - 0.3 * points[:, 0] / sides[0]
    corners = np.array([[0, 0, 0], [0, sides[1], 0], [sides[0], 0, 0], [sides[0], sides[1], sides[2]]])
    points = np.concatenate([points, corners]) + (0, 0, 0.5)
    return points.astype(np.float32), rng.integers(0, 256, points.shape, np.uint8)


def clouds(*sides: tuple[float, float, float]) -> thor2.PointClouds:
    return thor2.PointClouds.pack([box(each, k) for k, each in enumerate(sides)])


LONG, SQUARE = (0.2, 0.1, 0.06), (0.12, 0.115, 0.06)


@pytest.mark.parametrize("count", ORIENTATION_COUNTS)
def test_the_first_orientation_is_that_of_align(count: int) -> None:
    batch = clouds(LONG, SQUARE, LONG)
    (oriented, _), expected = candidate_orientations(batch, CONFIG, count), thor2.align(batch, CONFIG)
    assert oriented.points.shape == (3 * count, *batch.points.shape[1:])
    np.testing.assert_allclose(oriented.points[::count], expected.points, atol=1e-6)
    np.testing.assert_allclose(oriented.camera[::count], expected.camera, atol=1e-6)
    np.testing.assert_array_equal(oriented.colors[::count], batch.colors)
    np.testing.assert_array_equal(oriented.mask[count - 1 :: count], batch.mask)


def test_the_second_orientation_is_a_half_turn_about_z() -> None:
    batch = clouds(LONG, SQUARE)
    turned, _ = candidate_orientations(batch, CONFIG, 2)
    mirrored = thor2.turn(thor2.mirror(thor2.view_normalize(batch, CONFIG), "xy"), CONFIG)
    points = np.asarray(turned.points)[1::2]
    np.testing.assert_allclose(points, mirrored.points, atol=2e-6)


def test_sides_are_swapped_only_if_nearly_equal() -> None:
    oriented, _ = candidate_orientations(clouds(LONG, SQUARE), CONFIG, 4)
    points = np.asarray(oriented.points).reshape(2, 4, -1, 3)
    mask = np.asarray(oriented.mask).reshape(2, 4, -1)
    width = [np.ptp(points[cloud, k][mask[cloud, k]][:, 1]) for cloud in range(2) for k in (0, 2)]
    assert width[0] == pytest.approx(width[1], abs=1e-6)
    assert width[3] > width[2] + 0.01
    np.testing.assert_allclose(points[0, 2], points[0, 0], atol=1e-6)


def test_an_empty_cloud_stays_empty() -> None:
    empty = thor2.PointClouds.pack([(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))])
    oriented, _ = candidate_orientations(empty, CONFIG, 4)
    assert not oriented.mask.any() and bool(jnp.isfinite(oriented.points).all())


@pytest.mark.parametrize("count", [0, 3, 5])
def test_other_counts_are_refused(count: int) -> None:
    with pytest.raises(thor2.InputError, match=f"count is {count}"):
        candidate_orientations(clouds(LONG), CONFIG, count)
    with pytest.raises(thor2.InputError, match=f"count is {count}"):
        describe_orientations(clouds(LONG), colornet.load_default(), CONFIG, count)


@pytest.mark.parametrize(("backend", "calls"), [("cpu", 3), ("gpu", 1)])
def test_chunks_have_the_descriptors_of_the_batch(backend: str, calls: int, monkeypatch: pytest.MonkeyPatch) -> None:
    batch, network = clouds(LONG, SQUARE, LONG), colornet.load_default()
    whole = describe_orientations(batch, network, CONFIG, 4)
    sizes = []

    def record(chunk: thor2.PointClouds, config: thor2.DescriptorConfig, count: int) -> Any:
        sizes.append(len(chunk.mask))
        return candidate_orientations(chunk, config, count)

    monkeypatch.setattr(chunking, "MAX_LARGE_CHUNK_POINTS", 4 * batch.mask.shape[1])
    monkeypatch.setattr(orientations, "candidate_orientations", record)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    chunked = describe_orientations(batch, network, CONFIG, 4)
    assert len(sizes) == calls
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), chunked, whole)


def test_an_occluded_end_decides_the_half_turn() -> None:
    batch = clouds(LONG, SQUARE)
    x = np.asarray(thor2.view_normalize(batch, CONFIG).points)[0, :, 0]
    boundary = np.zeros(batch.mask.shape, bool)
    boundary[0] = np.asarray(batch.mask)[0] & (x > x.max() - 0.01)
    _, weights = candidate_orientations(dataclasses.replace(batch, boundary=jnp.asarray(boundary)), CONFIG, 4)
    np.testing.assert_allclose(weights, [[0.5, 0, 0.5, 0], [0.25, 0.25, 0.25, 0.25]])


def test_descriptors_of_orientations_are_those_of_their_clouds() -> None:
    network, batch = colornet.load_default(), clouds(LONG, SQUARE)
    described = describe_orientations(batch, network, CONFIG, 4)
    aligned, _ = candidate_orientations(batch, CONFIG, 4)
    expected = thor2.describe_aligned(aligned, network, CONFIG)
    np.testing.assert_array_equal(described.flat[0].tops2, expected.tops2)
    np.testing.assert_allclose(described.first.tops2, thor2.describe(batch, network, CONFIG).tops2, atol=1e-4)
    assert described.statistics.shape[:2] == described.weights.shape == (2, 4)
