"""The backends, execution modes and buckets in which every property is tested."""

import dataclasses
import functools
import itertools
from typing import Any

import jax
import pytest

import colornet
import thor2_jax as thor2

NETWORK = colornet.load_default()
SIZE = 4
"""Number of clouds in a batch; under vmap, two batches of two."""


@dataclasses.dataclass(frozen=True)
class Pipeline:
    """The functions under test, called directly, under jit or under vmap, with clouds padded to one capacity."""

    config: thor2.DescriptorConfig
    mode: str
    capacity: int

    def _call(self, function: Any, *arguments: Any) -> Any:
        return _compiled(function, self.config, self.mode)(*arguments)

    def describe(self, clouds: thor2.PointClouds, parameters: thor2.Parameters | None = None) -> thor2.Descriptors:
        return self._call(thor2.describe, clouds, parameters or thor2.Parameters.of(NETWORK, self.config))

    def describe_aligned(
        self, aligned: thor2.PointClouds, parameters: thor2.Parameters | None = None
    ) -> thor2.Descriptors:
        return self._call(thor2.describe_aligned, aligned, parameters or thor2.Parameters.of(NETWORK, self.config))


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
