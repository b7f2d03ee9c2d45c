"""The soft descriptor: towards zero temperature it is the hard one; above, nothing jumps and every gradient flows."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit
from slow_tier import slow

import thor2_jax as thor2
from colornet.colors import GRID_WHITE
from colornet.colors import hyab as exact_hyab
from colornet.colors import to_lab as exact_lab
from thor2_jax.descriptor.slicing import interval_log_weights, region_sets, soft_regions

from .conftest import NETWORK

HARD = thor2.DescriptorConfig(homology="closed_form")
SETS = region_sets(NETWORK)
shares_of = jax.jit(lambda colors, temperature: soft_regions(colors, SETS, temperature))


def relaxed(factor: float) -> thor2.DescriptorConfig:
    temperatures = {name: factor * value for name, value in dataclasses.asdict(thor2.Relaxation()).items()}
    return dataclasses.replace(HARD, relaxation=thor2.Relaxation(**temperatures))


def test_points_outside_the_hard_slices_are_left_out() -> None:
    inside = [[0.01, 0.1, 0.05], [0.012, 0.3, 0.05]]
    outside = [[-0.1, 0, 0.05], [0.1, 0, -0.2], [0.9, 0, 0], [0.1, 0, 2]]
    clouds = thor2.PointClouds.pack([(np.array(inside + outside), np.full((6, 3), 0.2))], 16)
    hard, soft = (thor2.describe_aligned(clouds, NETWORK, config) for config in (HARD, relaxed(0.01)))
    np.testing.assert_allclose(soft.tops2, hard.tops2, atol=1e-3)
    assert int(soft.overflow[0]) == int(hard.overflow[0]) == 4


def test_weights_of_intervals_are_differences_of_sigmoids() -> None:
    at = np.linspace(0, 1.2, 500)[:, None]
    lower, upper = (0.1 * (np.arange(7) + k) for k in (0, 1))
    for temperature in (0.003, 0.05, 1.0):
        above_lower, above_upper = (expit((at - edges) / temperature) for edges in (lower, upper))
        expected = np.where(lower > 0, above_lower, 1) - above_upper
        weights = np.exp(interval_log_weights(jnp.asarray(at[:, 0], jnp.float32), 0.1, 7, temperature))
        np.testing.assert_allclose(weights, expected, atol=2e-5)
        np.testing.assert_allclose(weights.sum(axis=1), 1 - above_upper[:, -1], atol=2e-5)


def test_cold_colours_are_in_the_hard_regions() -> None:
    """Includes colours with another grid colour nearer by HyAB, and the ends of the channels."""
    rgb = np.random.default_rng(0).integers(0, 256, (4000, 3), dtype=np.uint8)
    rgb[:1000] = np.random.default_rng(1).choice([0, 1, 2, 253, 254, 255], (1000, 3))
    colors = np.asarray(rgb / 255, np.float32)
    for temperature in (0.05, 0.001, 1e-6):
        np.testing.assert_allclose(shares_of(colors, temperature), NETWORK.membership(rgb), atol=1e-5)


def test_warm_colours_are_shared_by_the_softmax() -> None:
    """Compare grid colours with a sum in float64 over their 27 neighbours."""
    temperature, reach = 4.0, 0.5 + 4 / 5
    ends = np.random.default_rng(0).choice([0, 5, 10, 245, 250, 255], (12, 3)).tolist()
    colors = [[120, 35, 200], [0, 255, 5], [0, 0, 0], *ends]
    shares = shares_of(np.array(colors, np.float32) / np.float32(255), temperature)
    steps = np.array(list(np.ndindex(3, 3, 3))) - 1
    fade = np.prod((1 - (steps / reach) ** 2) ** 2, axis=1)
    for rgb, weights in zip(colors, shares, strict=True):
        others = np.array(rgb) + 5 * steps
        exist = ((others >= 0) & (others <= 255)).all(axis=1)
        distance = exact_hyab(exact_lab(np.array(rgb), GRID_WHITE), exact_lab(others, GRID_WHITE))
        share = exist * fade * np.exp(-distance / temperature)
        expected = share @ NETWORK.membership(others.clip(0, 255).astype(np.uint8)) / share.sum()
        np.testing.assert_allclose(weights, expected, atol=1e-5)


@pytest.mark.parametrize("temperature", [2.0, *slow(0.3, 30.0)])
def test_regions_change_without_a_jump_along_a_path_of_colours(temperature: float) -> None:
    path = np.linspace(0, 1, 40_001)[:, None] * [1.1, 0.7, -0.8] + [-0.05, 0.1, 0.9]
    weights = np.asarray(shares_of(path.astype(np.float32), temperature))
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)
    assert 0 < np.abs(np.diff(weights, axis=0)).max() < 0.03


def test_a_strip_that_is_left_vanishes_without_a_jump() -> None:
    """A slab with a wide range of y moves through four strips and two slices; nothing of the descriptor jumps."""
    rng = np.random.default_rng(0)
    points = rng.random((24, 3)) * [0.002, 0.4, 0.002]
    shifts = np.linspace(0, 1, 801)[:, None] * [0.1, 0, 0.15]
    clouds = thor2.PointClouds.pack([(points + shift, np.full((24, 3), 0.4)) for shift in shifts], 32)
    for config, largest in ((HARD, 10), (relaxed(1), 0.02)):
        config = dataclasses.replace(config, n_slices=2, n_strips=6)
        images = np.asarray(thor2.describe_aligned(clouds, NETWORK, config).images)
        steps = np.abs(np.diff(images, axis=0)).max(axis=(1, 2, 3))
        assert (steps.max() < largest) and (images.sum(axis=(1, 2, 3)) > 0).all()
        assert (steps.max() > 0.1) == (config.relaxation is None)
