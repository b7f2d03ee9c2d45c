"""The backends, execution modes and buckets in which every property is tested."""

import dataclasses
import functools
import itertools
from typing import Any

import jax
import pytest
from hypothesis import strategies as st
from small_clouds import NETWORK

import thor2_jax as thor2
from thor2_jax import testing as laws

GUDHI = thor2.DescriptorConfig(n_slices=3, n_strips=8, image_size=12)
CLOSED = dataclasses.replace(GUDHI, homology="closed_form")
SMALL_CONFIGS = {
    "closed_form": CLOSED,
    "gudhi": GUDHI,
    "relaxed": dataclasses.replace(CLOSED, relaxation=thor2.Relaxation()),
}
"""Descriptors that compile quickly."""


def batches(clouds: Any, capacity: int = 512) -> Any:
    """Generate batches of four clouds; under vmap, two batches of two."""
    return laws.packed(clouds, 4, capacity)


@dataclasses.dataclass(frozen=True)
class Pipeline:
    """The functions under test, called directly, under jit or under vmap, with clouds padded to one capacity."""

    config: thor2.DescriptorConfig
    mode: str
    capacity: int

    def draw(self, data: st.DataObject, clouds: Any) -> thor2.PointClouds:
        return data.draw(batches(clouds, self.capacity))

    def describe(self, clouds: thor2.PointClouds, parameters: Any = None, function: Any = thor2.describe) -> Any:
        parameters = parameters or thor2.Parameters.of(NETWORK, self.config)
        return _compiled(function, self.config, self.mode)(clouds, parameters)

    describe_aligned = functools.partialmethod(describe, function=thor2.describe_aligned)


@functools.cache
def _compiled(function: Any, config: thor2.DescriptorConfig, mode: str) -> Any:
    def call(clouds: thor2.PointClouds, parameters: thor2.Parameters) -> Any:
        return function(clouds, NETWORK, config, parameters)

    if mode == "plain":
        return call
    if mode == "jit":
        return jax.jit(call)
    mapped = jax.vmap(call, in_axes=(0, None))

    def in_pairs(clouds: thor2.PointClouds, parameters: thor2.Parameters) -> Any:
        pairs = jax.tree.map(lambda a: a.reshape(-1, 2, *a.shape[1:]), clouds)
        return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), mapped(pairs, parameters))

    return in_pairs


QUICK = {("gudhi", "jit", 512), ("closed_form", "vmap", 1024)}
"""Each backend and bucket once; other tests call the functions directly."""

WAYS = [
    pytest.param(way, marks=() if way in QUICK else pytest.mark.slow, id="-".join(map(str, way)))
    for way in itertools.product(("closed_form", "gudhi"), ("plain", "jit", "vmap"), (512, 1024))
]


@pytest.fixture(scope="session", params=WAYS)
def pipeline(request: pytest.FixtureRequest) -> Pipeline:
    """Backend, mode and bucket."""
    homology, mode, capacity = request.param
    return Pipeline(thor2.DescriptorConfig(homology=homology), mode, capacity)
