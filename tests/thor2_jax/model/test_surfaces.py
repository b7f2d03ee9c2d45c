"""Surfaces of classes: the points of an object fit the surface and the colours of its class better than others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_clouds import random_clouds

from thor2_jax.model.surfaces import Surfaces, evidence, with_evidence
from thor2_jax.types import Cloud, PointClouds
from training.objects.builtin_objects import builtin_objects
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


def test_views_fit_the_surface_of_their_own_class(surfaces: Surfaces, views: list[Cloud]) -> None:
    clouds = PointClouds.pack(views)
    values = np.stack([evidence(surfaces, clouds, jnp.full(len(views), k)) for k in range(3)], axis=1)  # [9, 3, 3]
    own = values[np.arange(9), OWN]
    assert (own[:, 0] < 0.5).all() and (own[:, 1:] > 0.5).all()
    others = values[np.arange(9)[:, None], (OWN[:, None] + [1, 2]) % 3]
    assert (others[..., 0] > own[:, None, 0] + 0.5).all()
    assert (others[..., 1:].sum(axis=-1) < own[:, None, 1:].sum(axis=-1) - 0.3).all()


def test_other_colours_do_not_fit(surfaces: Surfaces, views: list[Cloud]) -> None:
    inverted = [(xyz, 255 - rgb) for xyz, rgb in views]
    before, after = (np.asarray(evidence(surfaces, PointClouds.pack(each), OWN)) for each in (views, inverted))
    assert (after[:, 1:].sum(axis=1) < before[:, 1:].sum(axis=1) - 0.3).all()


def test_the_camera_may_be_anywhere(surfaces: Surfaces, views: list[Cloud]) -> None:
    """Cloud and camera are moved together; the search is not continuous."""
    position = np.array([0.3, -2, 5], np.float32)
    moved = PointClouds.pack([(xyz + position, rgb) for xyz, rgb in views], camera=np.tile(position, (9, 1)))
    before, after = (np.asarray(evidence(surfaces, each, OWN)) for each in (PointClouds.pack(views), moved))
    assert np.abs(after - before).max() < 0.3


def test_rows_do_not_depend_on_padding_and_other_rows(surfaces: Surfaces, views: list[Cloud]) -> None:
    whole = np.asarray(evidence(surfaces, PointClouds.pack(views), OWN))
    empty = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    padded = PointClouds.pack([views[4], empty, views[0]], 8192)
    values = np.asarray(evidence(surfaces, padded, np.array([1, 2, 0])))
    assert np.array_equal(values, [whole[4], np.zeros(3), whole[0]])


def test_few_points_and_noise_have_finite_evidence(surfaces: Surfaces) -> None:
    clouds = PointClouds.pack(random_clouds(0, (1, 3, 30, 500, 3000)))
    assert np.isfinite(evidence(surfaces, clouds, np.array([0, 1, 2, 0, 1]))).all()


@pytest.mark.parametrize("n_classes", [3, 1])
def test_probabilities_follow_the_evidence(surfaces: Surfaces, views: list[Cloud], n_classes: int) -> None:
    """Against the two formulas in float64."""
    surfaces = jax.tree.map(lambda field: field[:n_classes], surfaces)
    clouds, rng = PointClouds.pack(views), np.random.default_rng(0)
    before = rng.dirichlet(np.full(n_classes + 1, 0.4), 9)[:, :n_classes].astype(np.float32)
    after = np.asarray(with_evidence(jnp.asarray(before), surfaces, clouds), np.float64)
    values = [np.asarray(evidence(surfaces, clouds, np.full(9, k)), np.float64) for k in range(n_classes)]
    compared = 0
    for row, probabilities in enumerate(before.astype(np.float64)):
        best = np.argsort(-probabilities)[:2]
        if len(best) == 2 and probabilities[best[1]] > 0.1 * probabilities[best[0]]:
            odds = probabilities[best] * np.exp([values[k][row] @ [-7, 2.7, 1.5] for k in best])
            probabilities[best] = probabilities[best].sum() * odds / odds.sum()
            compared += 1
        known = probabilities.sum()
        odds = known / (1 - known) * np.exp(values[probabilities.argmax()][row] @ [-2.8, 1.5, 1.8] + 2.1)
        np.testing.assert_allclose(after[row], probabilities * odds / (1 + odds) / known, rtol=2e-3, atol=1e-6)
    assert compared == (0 if n_classes == 1 else pytest.approx(5, abs=3))
    assert np.array_equal(with_evidence(jnp.zeros((9, n_classes)), surfaces, clouds), np.zeros((9, n_classes)))


def test_surfaces_decide_between_the_two_best_names(views: list[Cloud]) -> None:
    """Two cans of one shape have different colours; a class that is far less probable is not compared."""
    cans = surfaces_of(builtin_objects()[name] for name in ("soup_can_green", "soup_can_red"))
    clouds = PointClouds.pack(views[:3])
    for red, is_named in ((0.2, True), (0.03, False)):
        probabilities = jnp.tile(jnp.array([0.4, red]), (3, 1))
        assert (np.asarray(with_evidence(probabilities, cans, clouds)).argmax(axis=1) == is_named).all()


def test_content(surfaces: Surfaces) -> None:
    again = Surfaces.of_content(surfaces.content)
    jax.tree.map(np.testing.assert_array_equal, again, surfaces)
    assert again.content == surfaces.content
