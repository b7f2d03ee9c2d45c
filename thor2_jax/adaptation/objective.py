"""How uncertain the answers for unlabelled instances are, as a function of the colour transform.

The entropy of an answer is over the classes and over "none of them", whose probability is what the classes lack to 1.
An unknown object that is surely none of the classes is therefore no reason to change the colours. So that it is no way
out to make all objects unknown, -log of the probability of being known is added, with the weight of that probability
before any change.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.adaptation.color_transform import transform_colors
from thor2_jax.capacity import point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.model.classifier import Classifier
from thor2_jax.types import PointClouds

__all__ = ["Criterion", "Objective", "entropy"]

ROWS = 8
"""Instances that are described in one call."""

LOOKS = 2
"""Looks at an instance; the colours of further ones differ."""

MIN_KNOWN = 1e-3
"""Smallest probability of being known that is distinguished from 0."""


class Criterion(NamedTuple):
    """The colour network, the descriptor and the classifier whose certainty an estimate increases."""

    network: ColorNetwork
    config: DescriptorConfig
    classify: Classifier


def entropy(probabilities: jax.Array) -> jax.Array:
    """Return the entropy [B] of probabilities [B, C] and of what they lack to 1, in nats."""
    rest = jnp.clip(1 - probabilities.sum(axis=-1, keepdims=True), 0, 1)
    every = jnp.clip(jnp.concatenate([probabilities, rest], axis=-1), 1e-12, 1)
    return -(every * jnp.log(every)).sum(axis=-1)


@jax.jit
def _transformed(clouds: PointClouds, parameters: jax.Array) -> PointClouds:
    return dataclasses.replace(clouds, colors=transform_colors(parameters, clouds.colors))


@jax.jit
def _uncertainties(probabilities: jax.Array, known_before: jax.Array) -> jax.Array:
    known = jnp.clip(probabilities.sum(axis=1), MIN_KNOWN, 1)
    return entropy(probabilities) - known_before * jnp.log(known)


class Objective:
    """The uncertainties of instances under colour transforms."""

    def __init__(
        self, instances: Sequence[PreparedInstance], criterion: Criterion, capacity: int | None = None
    ) -> None:
        """Pack the instances, and classify them without a transform.

        Args:
            instances: usable instances with the camera's colours.
            criterion: what computes the answers.
            capacity: N, points in a row, so that only one shape is compiled; larger clouds are left out. By default
                each chunk has the point bucket of its largest cloud.
        """
        config = dataclasses.replace(criterion.config, homology="closed_form", relaxation=None)
        self._criterion = criterion._replace(config=config)
        fitting = [each for each in instances if capacity is None or len(each.points) <= capacity]
        ordered = sorted(fitting, key=lambda each: len(each.points))
        self._chunks = []
        for start in range(0, len(ordered), ROWS):
            part = ordered[start : start + ROWS]
            clouds = pack_instances(part, ROWS, capacity or point_bucket(len(part[-1].points)))
            known = jnp.minimum(self._probabilities(clouds).sum(axis=1), 1)
            self._chunks.append((len(part), clouds, known))

    def _probabilities(self, clouds: PointClouds) -> jax.Array:
        network, config, classify = self._criterion
        return classify(describe_looks(clouds, network, config, LOOKS).with_balanced(clouds))

    def total(self, parameters: NDArray[np.floating]) -> float:
        """Return the sum of the uncertainties for parameters [4] of a colour transform."""
        transform = jnp.asarray(parameters, jnp.float32)
        values = [
            (count, _uncertainties(self._probabilities(_transformed(clouds, transform)), known))
            for count, clouds, known in self._chunks
        ]
        return float(sum(np.asarray(value)[:count].sum() for count, value in values))
