"""Temperatures of a fold's classifiers, from the views that it holds out."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.recognition.classifier import MLP, Feature, class_probabilities
from training.fitting.samples import Batch, Samples
from training.fitting.steps import describe_batch
from training.fitting.temperature import fit_temperature

__all__ = ["sample_probabilities", "temperatures"]

SAMPLES_PER_BATCH = 256
"""Samples computed together."""


@partial(jax.jit, static_argnums=(0, 3, 4, 5))
def _probabilities(
    graph: Any, state: Any, batch: Batch, feature: Feature, network: ColorNetwork, config: DescriptorConfig
) -> jax.Array:
    return class_probabilities(nnx.merge(graph, state), describe_batch(batch, network, config), feature)


def sample_probabilities(
    model: MLP,
    samples: Samples,
    rows: NDArray[np.intp],
    feature: Feature,
    network: ColorNetwork,
    config: DescriptorConfig,
) -> NDArray[np.float32]:
    """[len(rows), C] class probabilities of samples; the other arguments are those of `fit`."""
    config = dataclasses.replace(config, homology="closed_form")
    graph, state = nnx.split(model)
    parts = [np.zeros((0, len(samples.classes)), np.float32)]
    for first in range(0, len(rows), SAMPLES_PER_BATCH):
        part = rows[first : first + SAMPLES_PER_BATCH]
        batch = samples.take(np.resize(part, SAMPLES_PER_BATCH))
        parts.append(np.asarray(_probabilities(graph, state, batch, feature, network, config))[: len(part)])
    return np.concatenate(parts)


def temperatures(
    classifiers: Mapping[Feature, MLP],
    samples: Samples,
    held_out: NDArray[np.bool_] | None,
    network: ColorNetwork,
    config: DescriptorConfig,
) -> dict[str, float]:
    """Each classifier's temperature; none if no samples were held out.

    Args:
        classifiers: trained on the other samples.
        samples: all of them.
        held_out: [M], which were held out.
        network: as in the fit.
        config: as in the fit.
    """
    if held_out is None or not held_out.any():
        return {}
    rows = np.flatnonzero(held_out)
    truth = samples.label[rows]
    return {
        name: fit_temperature(sample_probabilities(model, samples, rows, name, network, config), truth)
        for name, model in classifiers.items()
    }
