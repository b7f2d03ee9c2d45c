"""Statistics of clouds, compared with NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from small_clouds import random_clouds

import colornet
import thor2_jax as thor2
from colornet.lab import GRID_WHITE, to_lab
from thor2_jax.descriptor.cloud_statistics import (
    N_BALANCED,
    N_SCALARS,
    balanced_histogram,
    cloud_statistics,
    side_lengths,
)
from thor2_jax.descriptor.describe import strips

CONFIG = thor2.DescriptorConfig(homology="closed_form")


def test_statistics_of_a_cloud() -> None:
    ((points, colors),) = random_clouds(0, [300])
    clouds = thor2.PointClouds.pack([(points, colors)])
    aligned, network = thor2.align(clouds, CONFIG), colornet.load_default()
    described = strips(aligned, network, CONFIG)
    values = np.asarray(cloud_statistics(jnp.asarray([[0.5, 0.25, 0.125]]), aligned, described))[0]
    scalars = [1, 0.5, 0.25, 0.75, np.sqrt(300) / 20, *colors.mean(axis=0) / 255, *colors.std(axis=0) / 255, 0.5]
    region_points = np.asarray(described.color).sum(axis=(0, 1, 2))
    expected = [*scalars, *np.sqrt(region_points / region_points.sum())]
    assert len(scalars) == N_SCALARS
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
    actual = balanced_histogram(jnp.asarray(colors, jnp.float32)[None], jnp.asarray(mask)[None])
    assert actual.shape == (1, N_BALANCED)
    np.testing.assert_allclose(np.square(actual[0]), expected.ravel(), atol=1e-3)


def test_side_lengths_are_those_before_the_turn() -> None:
    rng = np.random.default_rng(1)
    points = rng.random((300, 3)) * (0.2, 0.1, 0.05)
    clouds = thor2.PointClouds.pack([(points.astype(np.float32), np.zeros((300, 3), np.uint8))])
    normal = np.asarray(thor2.view_normalize(clouds, CONFIG).points)[0]
    sides = side_lengths(thor2.align(clouds, CONFIG), CONFIG.alpha)[0]
    np.testing.assert_allclose(sides, np.sort(np.ptp(normal, axis=0))[::-1], atol=1e-4)


def test_statistics_of_one_color_have_gradients() -> None:
    clouds = thor2.PointClouds.pack([(np.random.default_rng(0).random((50, 3)), np.full((50, 3), 90, np.uint8))])
    described = strips(thor2.align(clouds, CONFIG), colornet.load_default(), CONFIG)

    def total(colors: jax.Array, vectors: jax.Array) -> jax.Array:
        changed = dataclasses.replace(clouds, colors=colors), dataclasses.replace(described, color=vectors)
        return cloud_statistics(jnp.ones((1, 3)), *changed).sum()

    assert not np.asarray(described.color).sum(axis=(0, 1, 2)).all()  # most colour regions have no point
    of_colors, of_vectors = jax.grad(total, (0, 1))(clouds.colors, described.color)
    assert np.isfinite(of_colors).all() and np.asarray(of_colors).any() and np.isfinite(of_vectors).all()
