"""Gradients of the descriptor against finite differences in float64, away from ties; both backends; jit and vmap."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slow_tier import slow

import thor2_jax as thor2
from thor2_jax.descriptor import view_normalization

from .conftest import CLOSED, GUDHI, NETWORK, SMALL_CONFIGS

CONFIGS = SMALL_CONFIGS | {"relaxed-gudhi": dataclasses.replace(GUDHI, relaxation=thor2.Relaxation())}
COUNT, CAPACITY = 44, 48


def in_cells(seed: int) -> np.ndarray:
    """Return points of the first octant that stay in their slice and strip after a small step."""
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, [8, 1, 3], (COUNT, 3))
    return (cells + rng.uniform(0.1, 0.9, (COUNT, 3))) * [0.025, 0.25, 0.1]


def in_metres(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.random((COUNT, 3)) * [0.09, 0.06, 0.03]
    points = points[np.argsort(points[:, 0])] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return points + [0.02, 0.1, 0.6]


def clouds_of(make: Callable[[int], np.ndarray], count: int = 2, dtype: Any = np.float64) -> thor2.PointClouds:
    packed = thor2.PointClouds.pack([(make(k), np.zeros((COUNT, 3))) for k in range(count)], CAPACITY)
    points = np.zeros(packed.points.shape)
    points[:, :COUNT] = [make(k) for k in range(count)]
    colors = np.random.default_rng(9).uniform(0.05, 0.95, points.shape)
    return dataclasses.replace(packed, points=jnp.asarray(points, dtype), colors=jnp.asarray(colors, dtype))


def checked_derivatives(
    describe: Callable[..., thor2.Descriptors], clouds: thor2.PointClouds, config: thor2.DescriptorConfig
) -> list[float]:
    """Return the derivative of each input along a random direction, after a comparison with a central difference.

    The derivatives are those of a sum of all outputs with random weights of both signs.
    """

    def loss(points: jax.Array, colors: jax.Array, parameters: thor2.Parameters) -> jax.Array:
        tops2 = describe(dataclasses.replace(clouds, points=points, colors=colors), NETWORK, config, parameters).tops2
        probe = np.random.default_rng(5).normal(size=tops2.shape[-1])
        return (tops2 * jnp.asarray(probe, tops2.dtype)).sum()

    parameters = thor2.Parameters.of(NETWORK, dataclasses.replace(config, persistence_weight=1.3))
    arguments, step = (clouds.points, clouds.colors, jax.tree.map(jnp.float64, parameters)), 1e-6
    leaves, tree = jax.tree.flatten(arguments)
    value = jax.jit(lambda *leaves: loss(*jax.tree.unflatten(tree, leaves)))
    gradients = jax.tree.leaves(jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*arguments))
    rng, derivatives = np.random.default_rng(1), []
    for k, (leaf, gradient) in enumerate(zip(leaves, gradients, strict=True)):
        assert gradient.dtype == np.float64
        direction = rng.normal(size=leaf.shape) * float(step * jnp.abs(leaf).max())
        ends = [value(*leaves[:k], leaf + sign * direction, *leaves[k + 1 :]) for sign in (1, -1)]
        expected = float(ends[0] - ends[1]) / 2 / step
        along = float((gradient * direction).sum()) / step
        assert along == pytest.approx(expected, rel=2e-5, abs=1e-6), f"argument {k}"
        derivatives.append(along)
    return derivatives


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", ["gudhi", "closed_form", *slow("relaxed", "relaxed-gudhi")])
def test_aligned_clouds_against_finite_differences(name: str) -> None:
    """Of a batch, and of single clouds under vmap for gudhi."""
    config, aligned = CONFIGS[name], clouds_of(in_cells)

    def describe_each(clouds: thor2.PointClouds, *settings: Any) -> thor2.Descriptors:
        one = jax.tree.map(lambda a: a[:, None], clouds)
        return jax.tree.map(lambda a: a[:, 0], jax.vmap(lambda cloud: thor2.describe_aligned(cloud, *settings))(one))

    describe = describe_each if config.homology == "gudhi" else thor2.describe_aligned
    points, colors, similarity, alpha, sigma_s, variance, weight = checked_derivatives(describe, aligned, config)
    assert 0 not in (points, similarity, variance, weight) and alpha == sigma_s == 0  # the clouds are already aligned
    assert (colors != 0) == (config.relaxation is not None)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", [pytest.param("closed_form", marks=pytest.mark.slow), "relaxed"])
def test_describe_against_finite_differences(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame is fixed, since no gradient goes through it."""
    config, clouds = CONFIGS[name], clouds_of(in_metres, 1)
    frame = jnp.asarray(np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0])

    def box(points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        turned = frame @ points
        return frame, turned.min(axis=1), turned.max(axis=1)

    monkeypatch.setattr(view_normalization, "minimal_box", box)

    def describe(clouds: thor2.PointClouds, *settings: Any) -> thor2.Descriptors:
        # The function that is already compiled contains another frame.
        parameters = settings[-1]
        points, camera = view_normalization._align.__wrapped__(clouds, parameters.sigma_s, parameters.alpha)
        return thor2.describe_aligned(dataclasses.replace(clouds, points=points, camera=camera), *settings)

    points, colors, similarity, alpha, sigma_s, variance, weight = checked_derivatives(describe, clouds, config)
    assert 0 not in (points, similarity, sigma_s, variance, weight)
    for value in (colors, alpha):
        assert (value != 0) == (config.relaxation is not None)


def test_default_parameters_are_those_of_network_and_config() -> None:
    clouds = clouds_of(in_metres, 2, np.float32)
    config = dataclasses.replace(CLOSED, alpha=0.6, sigma_s=2.0, image_variance=0.0005, persistence_weight=1.5)
    by_default = thor2.describe(clouds, NETWORK, config)
    explicit = thor2.describe(clouds, NETWORK, CLOSED, thor2.Parameters.of(NETWORK, config))
    jax.tree.map(np.testing.assert_array_equal, explicit, by_default)
    assert np.abs(np.asarray(by_default.tops2 - thor2.describe(clouds, NETWORK, CLOSED).tops2)).max() > 0.01
