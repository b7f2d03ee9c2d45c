"""Degenerate clouds: values and gradients are finite, hard and relaxed, under jit and vmap."""

import dataclasses
import itertools
from typing import Any

import jax
import numpy as np
import pytest
from small_clouds import DEGENERATE

import thor2_jax as thor2

from .conftest import CLOSED, NETWORK, SMALL_CONFIGS

CONFIGS = {
    **SMALL_CONFIGS,
    "cold": dataclasses.replace(CLOSED, relaxation=thor2.Relaxation(1e-5, 1e-6, 1e-5, 1e-4), persistence_weight=0.5),
    "warm": dataclasses.replace(CLOSED, relaxation=thor2.Relaxation(1.0, 1.0, 1.0, 100.0), persistence_weight=2.0),
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


QUICK = [("cold", True), ("closed_form", False)]
SLOW = sorted(set(itertools.product(CONFIGS, (True, False))) - set(QUICK))


@pytest.mark.parametrize(("name", "aligned"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)])
def test_values_and_gradients_are_finite(name: str, aligned: bool) -> None:
    colors = [np.repeat(np.resize(GREYS, len(points))[:, None], 3, axis=1) for points in CLOUDS.values()]
    clouds = thor2.PointClouds.pack(list(zip(CLOUDS.values(), colors, strict=True)), 112)
    config, describe = CONFIGS[name], thor2.describe_aligned if aligned else thor2.describe

    def outputs(cloud: thor2.PointClouds, points: Any, colors: Any, parameters: Any) -> Any:
        one = dataclasses.replace(cloud, points=points, colors=colors)
        descriptors = describe(jax.tree.map(lambda a: a[None], one), NETWORK, config, parameters)
        return descriptors.tops2.sum() + (descriptors.tops2**2).sum(), descriptors

    def each(cloud: thor2.PointClouds) -> Any:
        parameters = thor2.Parameters.of(NETWORK, config)
        differentiated = jax.value_and_grad(outputs, argnums=(1, 2, 3), has_aux=True)
        return differentiated(cloud, cloud.points, cloud.colors, parameters)

    (_, descriptors), gradients = jax.jit(jax.vmap(each))(clouds)
    for path, leaf in jax.tree_util.tree_leaves_with_path((descriptors, gradients)):
        finite = np.isfinite(np.asarray(leaf)).reshape(len(CLOUDS), -1).all(axis=1)
        assert finite.all(), (jax.tree_util.keystr(path), np.array(list(CLOUDS))[~finite])
    assert not any(leaf[0].any() for leaf in jax.tree.leaves((descriptors.tops2, gradients)))  # without points
    if name == "closed_form" and not aligned:
        described, persistent = (
            {cloud for cloud, values in zip(CLOUDS, np.asarray(a), strict=True) if values.any()}
            for a in (descriptors.embeddings, descriptors.images)
        )
        assert CLOUDS.keys() - described == {"nothing", "large"}  # which is past the grid
        assert described - persistent == {"one point", "two points", "all equal", "the origin", "line along x"}
