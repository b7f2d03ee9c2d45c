"""Surfaces of classes: the points of an object fit the surface and the colours of its class better than others."""

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import ArrayLike
from small_clouds import random_clouds

from thor2_jax.model.inference import _with_evidence_in_threads as in_threads
from thor2_jax.surfaces.evidence import (
    Sample,
    fit_poses,
    sample_points,
    search_poses,
    with_evidence,
    with_evidence_on_host,
)
from thor2_jax.surfaces.surfaces import Surfaces
from thor2_jax.types import Cloud, PointClouds
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh
from training.objects.surfaces import surfaces_of
from training.rendering.camera import camera_pose
from training.views.mesh_views import view_cloud

OBJECTS = {name: builtin_objects()[name] for name in ("soup_can_red", "yellow_box", "banana")}
POSES = [(0.4, 1.1), (2.5, 0.7), (4.4, 1.4)]


@pytest.fixture(scope="module")
def surfaces() -> Surfaces:
    return surfaces_of(OBJECTS.values())


@pytest.fixture(scope="module")
def views() -> list[Cloud]:
    """Three views of each object."""
    return [view_cloud(mesh, camera_pose(*angles, mesh.centre)) for mesh in OBJECTS.values() for angles in POSES]


OWN = np.repeat(np.arange(3), 3)
"""Class of each view."""


def evidence(surfaces: Surfaces, clouds: PointClouds, class_index: ArrayLike) -> jax.Array:
    """Return the evidence of nine rows at most; they are repeated, since other numbers of rows compile again."""
    clouds, index = jax.tree.map(lambda a: np.resize(a, (9, *a.shape[1:])), (clouds, np.asarray(class_index)))
    return search_poses(surfaces, sample_points(clouds), index)[0][: np.size(class_index)]


def test_views_fit_the_surface_of_their_own_class(surfaces: Surfaces, views: list[Cloud]) -> None:
    clouds = PointClouds.pack(views)
    values = np.stack([evidence(surfaces, clouds, jnp.full(len(views), k)) for k in range(3)], axis=1)  # [9, 3, 4]
    own = values[np.arange(9), OWN]
    assert (own[:, 0] < 7 / 21).all() and (own[:, 1:3] > 0.5).all()  # distances with a weight of 21 change odds by e^7
    others = values[np.arange(9)[:, None], (OWN[:, None] + [1, 2]) % 3]
    assert (others[..., 0] > own[:, None, 0] + 7 / 21).all()
    assert (others[..., 1:3].sum(axis=-1) < own[:, None, 1:3].sum(axis=-1) - 0.3).all()


def with_background(views: list[Cloud], depths: list[float], whole: list[Cloud] | None = None) -> PointClouds:
    """Return clouds with points at these depths around each view, or around the `whole` object."""
    around = []
    for (seen, _), depth in zip(whole or views, depths, strict=True):
        rays = seen[:, :2] / seen[:, 2:]
        low, high = rays.min(axis=0) - 0.06, rays.max(axis=0) + 0.06
        grid = np.stack(np.meshgrid(*np.linspace(low, high, 24).T), axis=-1)
        is_free = np.linalg.norm(grid[:, :, None] - seen[:, :2] / seen[:, 2:], axis=3).min(axis=2) > 0.008
        around.append(np.dstack([grid, np.where(is_free, depth, 0)]))
    return dataclasses.replace(PointClouds.pack(views), around=jnp.asarray(np.array(around), jnp.float32))


def test_the_surface_of_a_class_is_not_in_free_space(surfaces: Surfaces, views: list[Cloud]) -> None:
    """Half of a box that is not occluded is no box; another object may hide the other half."""
    whole = views[3:6]
    half = [tuple(a[xyz[:, 0] < np.median(xyz[:, 0])] for a in (xyz, rgb)) for xyz, rgb in whole]
    classes = np.full(3, 1)
    free = np.array(
        [
            evidence(surfaces, with_background(*each), classes)[:, 3]
            for each in ((whole, [3.0] * 3), (half, [3.0] * 3), (half, [0.2] * 3), (half, [3.0] * 3, whole))
        ]
    )
    assert (free[0] < 0.01).all() and (free[1] > 0.03).all() and (free[2] == 0).all() and (free[3] < 0.01).all()
    # Without `around`, any frame will do.
    turned = [(xyz * np.array([1, -1, -1], np.float32), rgb) for xyz, rgb in half]
    for each in (half, turned):
        np.testing.assert_array_equal(evidence(surfaces, PointClouds.pack(each), classes)[:, 3], 0)


def test_points_off_the_surface_near_the_contour_do_not_count(surfaces: Surfaces, views: list[Cloud]) -> None:
    """A mask that is too large adds points of the table beside the box."""
    loose, rims = [], []
    for xyz, rgb in views[3:6]:
        table = np.unique(xyz[::4] * [0, 1, 1] + [xyz[:, 0].max() + 0.03, 0, 0], axis=0).astype(np.float32)
        rims.append(np.arange(len(xyz) + len(table)) >= len(xyz))
        loose.append((np.concatenate([xyz, table]), np.concatenate([rgb, rgb[: len(table)]])))
    tight, marked, unmarked = (
        np.asarray(evidence(surfaces, PointClouds.pack(clouds, rim=rim), np.full(3, 1)))[:, 0]
        for clouds, rim in ((views[3:6], None), (loose, rims), (loose, None))
    )
    assert (marked < tight + 6 / 21).all() and (unmarked > marked + 6 / 21).all(), (tight, marked, unmarked)
    t = np.linspace(0, 2 * np.pi, 300)
    ring = [(np.stack([np.cos(t), np.sin(t), 3 + 0 * t], axis=1).astype(np.float32), np.zeros((300, 3), np.uint8))]
    all_rim, none = (PointClouds.pack(ring, rim=rim) for rim in ([np.ones(300, bool)], None))
    off = [evidence(surfaces, clouds, np.zeros(1, int)) for clouds in (all_rim, none)]
    np.testing.assert_array_equal(*off)  # if no other point is left, these count


@pytest.mark.parametrize(("is_beside", "share"), [(False, 0.3), (True, 0.5)])
def test_points_off_the_surface_hardly_change_a_pose(
    is_beside: bool, share: float, surfaces: Surfaces, views: list[Cloud]
) -> None:
    """Depth of some points is wrong, or another object lies beside; the poses of the search are worse."""
    clouds = []
    for xyz, rgb in views:
        is_off = np.random.default_rng(0).random(len(xyz)) < share
        off = xyz[is_off] + [0.015, 0.03, 0] if is_beside else xyz[is_off] * (1 - 0.006 / xyz[is_off, 2:])
        kept = np.full(len(xyz), True) if is_beside else ~is_off
        points = np.concatenate([xyz[kept], off]).astype(np.float32) + 1
        clouds.append((points, np.concatenate([rgb[kept], rgb[is_off]])))
    packed = PointClouds.pack(clouds, camera=np.ones((9, 3), np.float32))
    after, before = (
        [np.median(surfaces.distances(OWN[k], np.asarray(poses[k]), xyz)) for k, (xyz, _) in enumerate(views)]
        for poses in (fit_poses(surfaces, packed, OWN), search_poses(surfaces, sample_points(packed), OWN)[1])
    )
    assert max(after) < 0.0008 < np.median(before), (after, before)


def test_the_camera_may_be_anywhere(surfaces: Surfaces, views: list[Cloud]) -> None:
    """Cloud and camera are moved together; the search is not continuous."""
    position = np.array([0.3, -2, 5], np.float32)
    moved = PointClouds.pack([(xyz + position, rgb) for xyz, rgb in views], camera=np.tile(position, (9, 1)))
    still = PointClouds.pack(views)
    np.testing.assert_allclose(sample_points(moved).points, sample_points(still).points, atol=1e-5)
    before, after = (np.asarray(evidence(surfaces, each, OWN)) for each in (still, moved))
    assert np.abs(after - before).max() < 0.3
    origin = views[0][0][0] * np.float32(0.99)  # near the surface, where padding lies then
    clouds = PointClouds.pack([(xyz - origin, rgb) for xyz, rgb in views], 8192, camera=np.tile(-origin, (9, 1)))
    poses = np.asarray(fit_poses(surfaces, clouds, OWN))
    assert max(np.median(surfaces.distances(OWN[k], poses[k], xyz)) for k, (xyz, _) in enumerate(views)) < 0.0007
    assert np.abs(poses[..., :3] @ poses[..., :3].mT - np.eye(3)).max() < 1e-5


def test_rows_do_not_depend_on_padding_and_other_rows(surfaces: Surfaces, views: list[Cloud]) -> None:
    whole = np.asarray(evidence(surfaces, PointClouds.pack(views), OWN))
    padded = PointClouds.pack([views[4], *random_clouds(0, [0]), views[0]], 8192)
    values = np.asarray(evidence(surfaces, padded, np.array([1, 2, 0])))
    assert np.array_equal(values, [whole[4], np.zeros(4), whole[0]])


def test_few_points_and_noise_have_finite_evidence(surfaces: Surfaces) -> None:
    """Also points that are far apart, for example in millimetres."""
    clouds = random_clouds(0, (1, 3, 30, 500, 3000))
    clouds.append((clouds[-1][0] * np.float32(1000), clouds[-1][1]))
    assert np.isfinite(evidence(surfaces, PointClouds.pack(clouds), np.array([0, 1, 2, 0, 1, 2]))).all()


def test_points_beyond_the_surface_count_with_the_largest_distance(surfaces: Surfaces) -> None:
    points = (np.random.default_rng(0).random((2000, 3)) * 3 + [0, 0, 2]).astype(np.float32)
    clouds = PointClouds.pack([(points, np.zeros((2000, 3), np.uint8))])
    error = 0.08 * np.linalg.norm(np.std(sample_points(clouds).points[0], axis=0))
    expected = [np.log((0.012 + error) / (0.001 + error)), 0, 0, 0]  # nothing is near, and no point has neighbours
    np.testing.assert_allclose(evidence(surfaces, clouds, np.zeros(1, int))[0], expected, atol=1e-3)


def test_samples_spread_over_large_clouds() -> None:
    x = np.linspace(0, 1, 3000, dtype=np.float32)
    line = np.stack([x, np.zeros_like(x), np.full_like(x, 0.5)], axis=1)
    chosen = sample_points(PointClouds.pack([(line, np.zeros((3000, 3), np.uint8))])).points
    np.testing.assert_allclose(np.sort(chosen[0, :, 0]), np.linspace(0, 1, 256), atol=0.02)


@pytest.mark.parametrize("noise", [3e-4, 1e-3])
def test_the_roughness_is_the_noise_of_a_plane(noise: float) -> None:
    """The plane through some twenty neighbours takes a part of the noise."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 0.08, (1000, 2)), 0.5 + rng.normal(0, noise, 1000)]).astype(np.float32)
    flat = points * np.array([1, 1, 0], np.float32) + np.array([0, 0, 0.5], np.float32)  # as a coarse step of depth
    rough = sample_points(PointClouds.pack([(each, np.zeros((1000, 3), np.uint8)) for each in (points, flat)])).rough
    assert 0.7 * noise < float(rough[0]) < 1.05 * noise and float(rough[1]) == pytest.approx(1e-3)


def test_one_colour_has_no_correlation() -> None:
    plate = builtin_objects()["white_plate"]
    nearly = 200 + np.random.default_rng(0).integers(0, 4, (len(plate.faces), 3, 3), dtype=np.uint8)
    plain = TexturedMesh(plate.vertices, plate.faces, corner_colors=nearly)
    clouds = PointClouds.pack([view_cloud(plain, camera_pose(*angles, plain.centre)) for angles in POSES])
    assert np.abs(evidence(surfaces_of([plain] * 3), clouds, np.zeros(3, int))[:, 1:]).max() < 0.05


def test_accelerators_compare_all_rows_at_once(
    surfaces: Surfaces, views: list[Cloud], monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    clouds = PointClouds.pack(views)
    expected = np.asarray(evidence(surfaces, clouds, OWN))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    search_poses.clear_cache()
    request.addfinalizer(search_poses.clear_cache)
    np.testing.assert_allclose(evidence(surfaces, clouds, OWN), expected, atol=1e-3)


@pytest.mark.parametrize("n_classes", [6, 1])
def test_probabilities_follow_the_evidence(surfaces: Surfaces, views: list[Cloud], n_classes: int) -> None:
    """Compare with the two formulas in float64, also if surfaces are those of separate objects; one cloud is empty."""
    samples = sample_points(with_background([*views[:8], *random_clouds(0, [0])], [3.0] * 9, views))
    twice = jax.tree.map(lambda field: jnp.concatenate([field, field])[:n_classes], surfaces)
    before = np.random.default_rng(0).dirichlet(np.full(n_classes + 1, 0.3), 9)[:, :n_classes].astype(np.float32)
    after = np.asarray(with_evidence(jnp.asarray(before), twice, samples), np.float64)
    values = [np.asarray(search_poses(surfaces, samples, np.full(9, k % 3))[0], float) for k in range(n_classes)]
    for row, probabilities in enumerate(before.astype(np.float64)):
        best, largest = list[int](), 0.0
        for k in np.argsort(-probabilities)[:5]:
            if probabilities[k] ** 0.5 * np.exp(1.5) >= largest:
                best.append(k)
                largest = max(largest, probabilities[k] ** 0.5 * np.exp(values[k][row] @ [-21, 2.7, 1.5, 0]))
        odds = probabilities[best] ** 0.5 * np.exp([values[k][row] @ [-21, 2.7, 1.5, 0] for k in best])
        probabilities[best] = probabilities[best].sum() * odds / odds.sum()
        known = probabilities.sum()
        fits = values[probabilities.argmax()][row] @ [-11.2, 1.5, 1, -15]
        odds = probabilities.max() / known * (known / (1 - known)) ** 0.5 * np.exp(fits + 2.55)
        np.testing.assert_allclose(after[row], probabilities * odds / (1 + odds) / known, rtol=2e-3, atol=1e-6)
    nothing = np.zeros((9, n_classes), np.float32)
    assert np.array_equal(with_evidence(jnp.asarray(nothing), twice, samples), nothing)
    each = [jax.tree.map(lambda field, k=k: field[k : k + 1], twice) for k in range(n_classes)]
    for p, expected in ((before, after), (nothing, nothing)):
        np.testing.assert_allclose(with_evidence_on_host(p, each, samples), expected, atol=1e-5)
    assert with_evidence_on_host(p[:0], each, jax.tree.map(lambda a: a[:0], samples)).shape == (0, n_classes)


def toy_search(values: jax.Array, samples: Sample, index: jax.Array) -> tuple[jax.Array, None]:
    """Return the products of a value of the row and values of the name, in place of the evidence."""
    return jnp.where(samples.is_skipped[:, None], 0, samples.rough[:, None] * values[index]), None


@pytest.mark.parametrize(
    ("logits", "fits", "first"),
    [
        *(((0, -1.4), (0, 5), 1), ((0, -1.6), (0, 5), 0)),
        *(((0, -0.1, -1), (0, 1, 5), 1), ((0, -0.1, -1), (1, 0, 5), 0)),
        *(((0, 0, 0, 0, -0.1), (0, 0, 0, 0, 5), 4), ((0, 0, 0, 0, 0, -0.1), (0, 0, 0, 0, 0, 5), 0)),
        ((-1, -np.inf), (-40, 5), 0),
    ],
)
def test_names_are_compared_while_they_may_come_first(
    logits: tuple[float, ...], fits: tuple[float, ...], first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last name fits best, but comes first only if it is compared."""
    monkeypatch.setattr("thor2_jax.surfaces.evidence.search_poses", toy_search)
    probabilities = np.exp(2 * np.pad([np.float32(logits)], ((0, 0), (0, 6 - len(logits))), constant_values=-np.inf))
    probabilities /= 2 * probabilities.sum()
    values = np.zeros((6, 4), np.float32)
    values[: len(fits), 2] = np.array(fits) / 1.5  # the weight of the lightness
    samples = Sample(*[jnp.ones(1)] * 5, is_skipped=jnp.zeros(1, bool))
    on_device = with_evidence(jnp.asarray(probabilities), jnp.asarray(values), samples)
    on_host = with_evidence_on_host(probabilities, list(jnp.asarray(values)[:, None]), samples)
    assert on_device.argmax() == on_host.argmax() == first
    np.testing.assert_allclose(on_host, on_device, atol=1e-6)


def test_threads_compare_the_same_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thor2_jax.surfaces.evidence.search_poses", toy_search)
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    samples = Sample(*[np.linspace(0, 1, 8, dtype=np.float32)] * 5, is_skipped=np.zeros(8, bool))
    p = np.random.default_rng(0).dirichlet(np.full(4, 0.4), 8)[:, :3].astype(np.float32)
    for n in (0, 1, 8):
        rows = jnp.asarray(p[:n]), np.eye(3, 4, dtype=np.float32), jax.tree.map(lambda a, n=n: a[:n], samples)
        assert np.array_equal(in_threads(*rows), with_evidence(*rows))
    for k in range(3):
        traced = jax.jit(lambda a, k=k: in_threads(*rows[:k], a, *rows[k + 1 :]))
        np.testing.assert_allclose(traced(rows[k]), with_evidence(*rows), atol=1e-4)


def test_only_points_well_in_front_of_what_is_seen_are_in_free_space(surfaces: Surfaces, views: list[Cloud]) -> None:
    """The middle of the view is that of the object; what lies beside the grid is unknown."""
    box = views[3]
    clouds = with_background([box], [3.0])
    middle = float(box[0][:, 2].min())
    for depth, is_free in ((middle + 0.018, False), (3.0, True)):
        seen = np.asarray(clouds.around).copy()
        seen[..., 2] = depth
        free = evidence(surfaces, dataclasses.replace(clouds, around=jnp.asarray(seen)), np.array([1]))[0, 3]
        assert (free == 0) != is_free, free
    for shift, expected in ((0, 1), (2, 0)):  # everything, nothing
        seen[..., :2] += shift
        moved = dataclasses.replace(clouds, around=jnp.asarray(seen))
        assert evidence(surfaces, moved, np.array([1]))[0, 3] == expected


@pytest.mark.usefixtures("x64")
def test_evidence_is_float32_in_float64_mode(surfaces: Surfaces, views: list[Cloud]) -> None:
    clouds = PointClouds.pack(views)
    results = jax.eval_shape(lambda: (evidence(surfaces, clouds, OWN), fit_poses(surfaces, clouds, OWN)))
    assert [result.dtype for result in results] == [np.float32] * 2
