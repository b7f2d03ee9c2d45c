"""The backends, execution modes and buckets in which every property is tested."""

import dataclasses
import functools
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


def ways(*capacities: int) -> list[Any]:
    """Return all combinations of backend, mode and bucket; those that are not in QUICK are marked slow."""
    parameters = []
    for n in capacities:
        for mode in ("plain", "jit", "vmap"):
            for homology in ("closed_form", "gudhi"):
                marks = () if (homology, mode, n) in QUICK else pytest.mark.slow
                parameters.append(pytest.param((homology, mode, n), marks=marks, id=f"{homology}-{mode}-{n}"))
    return parameters


def pipeline_of(way: tuple[Any, str, int]) -> Pipeline:
    return Pipeline(thor2.DescriptorConfig(homology=way[0]), way[1], way[2])


@pytest.fixture(scope="session", params=ways(512, 1024))
def pipeline(request: pytest.FixtureRequest) -> Pipeline:
    """Backend, mode and bucket."""
    return pipeline_of(request.param)


@pytest.fixture(scope="session", params=ways(512))
def small_pipeline(request: pytest.FixtureRequest) -> Pipeline:
    """Backend and mode, in the smallest bucket."""
    return pipeline_of(request.param)
