"""How uncertain the answers for unlabelled instances are, as a function of the colour transform.

The entropy of an answer is over the classes and over "none of them", whose probability is what the classes lack to 1.
An unknown object that is surely none of the classes is therefore no reason to change the colours. So that it is no way
out to make all objects unknown, -log of the probability of being known is added, with the weight of that probability
before any change.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.adaptation.color_transform import transform_colors
from thor2_jax.capacity import point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.color_membership import RegionSets, color_sets, region_sets
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import aligned_looks, describe_aligned_looks
from thor2_jax.descriptor.slicing import slices_and_strips
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.model.classifier import Classifier
from thor2_jax.types import PointClouds, Strips

__all__ = ["Objective", "entropy"]

ROWS = 8
"""Instances that are described in one call."""

MIN_KNOWN = 1e-3
"""Smallest probability of being known that is distinguished from 0."""


def entropy(probabilities: jax.Array) -> jax.Array:
    """Return the entropy [B] of probabilities [B, C] and of what they lack to 1, in nats."""
    rest = jnp.clip(1 - probabilities.sum(axis=-1, keepdims=True), 0, 1)
    every = jnp.clip(jnp.concatenate([probabilities, rest], axis=-1), 1e-12, 1)
    return -(every * jnp.log(every)).sum(axis=-1)


class _Chunk(NamedTuple):
    """Described geometry of instances, which does not depend on the colours.

    Attributes:
        clouds: [B, N].
        aligned: [B * K, N], the looks at them; their colours are not used.
        weights: [B, K].
        strips: of the looks; the colour vectors are not used.
        segment: [B * K, N] int32, number of each point's strip among all strips of all slices; past the last one if
            the point is in none.
        usable: [B] float32, 0 for padding.
        known: [B] float32, probability that an instance is of any of the classes, without a colour transform.
    """

    clouds: PointClouds
    aligned: PointClouds
    weights: jax.Array
    strips: Strips
    segment: jax.Array
    usable: jax.Array
    known: jax.Array


@partial(jax.jit, static_argnums=1)
def _segments(aligned: PointClouds, config: DescriptorConfig) -> jax.Array:
    """Return `_Chunk.segment` of aligned clouds."""
    x, _, z = jnp.moveaxis(aligned.points, -1, 0)
    i, j = jax.vmap(partial(slices_and_strips, config=config))(x, z, aligned.mask)
    inside = aligned.mask & (i >= 0) & (i < config.n_slices) & (j >= 0) & (j < config.n_strips)
    return jnp.where(inside, i * config.n_strips + j, config.n_slices * config.n_strips)


@partial(jax.jit, static_argnums=(3, 4, 5))
def _uncertainties(
    parameters: jax.Array,
    chunk: _Chunk,
    sets: RegionSets,
    network: ColorNetwork,
    config: DescriptorConfig,
    classify: Classifier,
) -> jax.Array:
    """Return the uncertainty of each instance of a chunk [ROWS], 0 for padding."""
    count = chunk.weights.shape[1]
    colors = transform_colors(parameters, chunk.clouds.colors)
    regions = sets.weights[color_sets(colors, sets)]  # [B, N, R]
    shape = chunk.strips.color.shape
    vectors = jnp.zeros((shape[0], shape[1] * shape[2], shape[3]))
    add = jax.vmap(lambda sums, rows, values: sums.at[rows].add(values, mode="drop"))
    vectors = add(vectors, chunk.segment, jnp.repeat(regions, count, axis=0))
    described = dataclasses.replace(chunk.strips, color=vectors.reshape(shape))
    aligned = dataclasses.replace(chunk.aligned, colors=jnp.repeat(colors, count, axis=0))
    oriented = describe_aligned_looks(aligned, chunk.weights, described, network, config)
    probabilities = classify(oriented)
    known = jnp.clip(probabilities.sum(axis=1), MIN_KNOWN, 1)
    return (entropy(probabilities) - chunk.known * jnp.log(known)) * chunk.usable


class Objective:
    """The uncertainties of instances under colour transforms."""

    def __init__(
        self,
        instances: Sequence[PreparedInstance],
        network: ColorNetwork,
        config: DescriptorConfig,
        classify: Classifier,
        looks: int = 2,
        capacity: int | None = None,
    ) -> None:
        """Describe the geometry of the instances.

        Args:
            instances: usable instances with the camera's colours.
            network: colour network.
            config: descriptor.
            classify: the classifier.
            looks: number of looks K, 1 or 2; the colours of further ones differ.
            capacity: N, points in a row, so that only one shape is compiled; larger clouds are left out. By default
                each chunk has the point bucket of its largest cloud.
        """
        self._network, self._classify = network, classify
        self._config = dataclasses.replace(config, homology="closed_form", relaxation=None)
        self._sets = region_sets(network)
        self._capacity = capacity
        fitting = [each for each in instances if capacity is None or len(each.points) <= capacity]
        ordered = sorted(fitting, key=lambda each: len(each.points))
        parts = [ordered[start : start + ROWS] for start in range(0, len(ordered), ROWS)]
        self._chunks = [self._describe(part, looks) for part in parts]

    def _describe(self, instances: Sequence[PreparedInstance], count: int) -> _Chunk:
        capacity = self._capacity or point_bucket(max(len(each.points) for each in instances))
        clouds = pack_instances(instances, ROWS, capacity)
        aligned, weights = aligned_looks(clouds, self._config, count)
        segment = _segments(aligned, self._config)
        described = strips(aligned, self._network, self._config)
        usable = jnp.asarray(np.arange(ROWS) < len(instances), jnp.float32)
        # A classifier that prepares its weights at the first call must not do so while JAX traces: it is called here.
        known = self._classify(describe_aligned_looks(aligned, weights, described, self._network, self._config)).sum(
            axis=1
        )
        return _Chunk(clouds, aligned, weights, described, segment, usable, jnp.minimum(known, 1))

    def total(self, parameters: NDArray[np.floating]) -> float:
        """Return the sum of the uncertainties for parameters [4] of a colour transform."""
        values = [
            _uncertainties(
                jnp.asarray(parameters, jnp.float32), chunk, self._sets, self._network, self._config, self._classify
            )
            for chunk in self._chunks
        ]
        return float(sum(np.asarray(value).sum() for value in values))
