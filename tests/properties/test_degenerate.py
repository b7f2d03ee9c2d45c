"""Degenerate clouds: values and gradients are finite, hard and relaxed, under jit and vmap."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DEGENERATE

import colornet
import thor2_jax as thor2

NETWORK = colornet.load_default()
SMALL = {"n_slices": 3, "n_strips": 8, "image_size": 12}
CONFIGS = {
    "closed_form": thor2.DescriptorConfig(homology="closed_form", **SMALL),
    "gudhi": thor2.DescriptorConfig(**SMALL),
    "relaxed": thor2.DescriptorConfig(homology="closed_form", relaxation=thor2.Relaxation(), **SMALL),
    "cold": thor2.DescriptorConfig(
        homology="closed_form", relaxation=thor2.Relaxation(1e-5, 1e-6, 1e-5, 1e-4), **SMALL
    ),
    "warm": thor2.DescriptorConfig(homology="closed_form", relaxation=thor2.Relaxation(1.0, 1.0, 1.0, 100.0), **SMALL),
}
ANGLE = np.arange(100)
BALL = np.stack([np.cos(ANGLE) * np.sin(ANGLE * 0.7), np.sin(ANGLE) * np.sin(ANGLE * 0.7), np.cos(ANGLE * 0.7)], axis=1)
CUBE = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
CLOUDS = {
    **DEGENERATE,
    "the origin": np.zeros((1, 3)),
    "line along x": np.linspace(0, 0.1, 41)[:, None] * [1.0, 0, 0] + 0.5,
    "ball": 0.03 * BALL + [0, 0, 0.6],
    "cube": 0.04 * CUBE + [0, 0, 0.6],
    "corners of a cube": 0.04 * CUBE[np.abs(CUBE).sum(axis=1) == 3],
    "duplicates": np.repeat(0.03 * BALL[:25], 4, axis=0),
    "large": 1e4 * BALL,
    "tiny": 1e-20 * BALL,
}
GREYS = np.linspace(0, 1, 256).astype(np.float32)
"""Every grey from black to white, on grid colours and between them."""


def packed() -> thor2.PointClouds:
    colors = [np.repeat(np.resize(GREYS, len(points))[:, None], 3, axis=1) for points in CLOUDS.values()]
    return thor2.PointClouds.pack(list(zip(CLOUDS.values(), colors, strict=True)), 112)


def assert_finite(tree: Any) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        assert np.isfinite(np.asarray(leaf)).all(), jax.tree_util.keystr(path)


QUICK = [("cold", True), ("closed_form", False)]
SLOW = [
    pytest.param(name, aligned, marks=pytest.mark.slow)
    for name in CONFIGS
    for aligned in (True, False)
    if (name, aligned) not in QUICK
]


@pytest.mark.parametrize(("name", "aligned"), QUICK + SLOW)
def test_values_and_gradients_are_finite(name: str, aligned: bool) -> None:
    config, clouds = CONFIGS[name], packed()
    describe = thor2.describe_aligned if aligned else thor2.describe

    def outputs(cloud: thor2.PointClouds, points: Any, colors: Any, parameters: Any) -> Any:
        one = dataclasses.replace(cloud, points=points, colors=colors)
        descriptors = describe(jax.tree.map(lambda a: a[None], one), NETWORK, config, parameters)
        return descriptors.tops2.sum() + (descriptors.tops2**2).sum(), descriptors

    def each(cloud: thor2.PointClouds) -> Any:
        parameters = thor2.Parameters.of(NETWORK, config)
        differentiated = jax.value_and_grad(outputs, argnums=(1, 2, 3), has_aux=True)
        return differentiated(cloud, cloud.points, cloud.colors, parameters)

    (_, descriptors), gradients = jax.jit(jax.vmap(each))(clouds)
    for k, cloud in enumerate(CLOUDS):
        of_cloud = jax.tree.map(lambda a: a[k], (descriptors, gradients))  # noqa: B023
        try:
            assert_finite(of_cloud)
        except AssertionError as error:
            raise AssertionError(f"{cloud}: {error}") from None
    empty = jax.tree.map(lambda a: np.asarray(a[0]), (descriptors.tops2, gradients))
    assert not any(leaf.any() for leaf in jax.tree.leaves(empty))
    if name == "closed_form" and not aligned:
        described = np.asarray(descriptors.embeddings).any(axis=(1, 2, 3, 4)).tolist()
        assert [cloud for cloud, any_strip in zip(CLOUDS, described, strict=True) if not any_strip] == [
            "nothing",
            "large",  # past the grid
        ]


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_strips_without_persistence(exponent: float) -> None:
    """If every strip holds one point, all persistences are 0, for any exponent of the weight."""
    points = np.stack([(np.arange(8) + 0.5) * 0.025, np.full(8, 0.1), np.full(8, 0.05)], axis=1)
    config = CONFIGS["closed_form"]
    aligned = thor2.PointClouds.pack([(points, np.full((8, 3), 0.5))], 16)

    def total(points: jax.Array, parameters: thor2.Parameters) -> jax.Array:
        return thor2.describe_aligned(
            dataclasses.replace(aligned, points=points), NETWORK, config, parameters
        ).images.sum()

    parameters = dataclasses.replace(
        thor2.Parameters.of(NETWORK, config), persistence_weight=jnp.asarray(exponent, jnp.float32)
    )
    value, gradients = jax.value_and_grad(total, argnums=(0, 1))(aligned.points, parameters)
    assert float(value) == 0
    assert_finite(gradients)
