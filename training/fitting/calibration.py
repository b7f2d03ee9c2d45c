"""Temperatures of a fold's classifiers, fitted on its held-out set."""

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
from thor2_jax.model.classifier import MLP, Feature, class_probabilities
from training.fitting.samples import Batch, Samples
from training.fitting.steps import FitContext, describe_batch
from training.fitting.temperature import fit_temperature

__all__ = ["sample_probabilities", "temperatures"]

SAMPLES_PER_BATCH = 256
"""Batch size of the predictions."""


@partial(jax.jit, static_argnums=(0, 1))
def _probabilities(context: FitContext, graph: Any, state: Any, batch: Batch) -> jax.Array:
    descriptors = describe_batch(batch, context.network, context.config)
    return class_probabilities(nnx.merge(graph, state), descriptors, context.feature)


def sample_probabilities(
    model: MLP, samples: Samples, rows: NDArray[np.intp], context: FitContext
) -> NDArray[np.float32]:
    """Return the class probabilities [len(rows), C] of samples; `context` is that of the fit."""
    context = dataclasses.replace(context, config=dataclasses.replace(context.config, homology="closed_form"))
    graph, state = nnx.split(model)
    chunks = [np.zeros((0, len(samples.classes)), np.float32)]
    for first in range(0, len(rows), SAMPLES_PER_BATCH):
        chunk = rows[first : first + SAMPLES_PER_BATCH]
        batch = samples.take(np.resize(chunk, SAMPLES_PER_BATCH))
        chunks.append(np.asarray(_probabilities(context, graph, state, batch))[: len(chunk)])
    return np.concatenate(chunks)


def temperatures(
    classifiers: Mapping[Feature, MLP],
    samples: Samples,
    held_out: NDArray[np.bool_] | None,
    network: ColorNetwork,
    config: DescriptorConfig,
) -> dict[str, float]:
    """Fit each classifier's temperature on the held-out set; return an empty dict if there is none.

    Args:
        classifiers: trained on the other samples.
        samples: all samples.
        held_out: [M], True for samples of the held-out set.
        network: as in the fit.
        config: as in the fit.
    """
    if held_out is None or not held_out.any():
        return {}
    rows = np.flatnonzero(held_out)
    truth = samples.label[rows]
    return {
        name: fit_temperature(sample_probabilities(model, samples, rows, FitContext(name, network, config)), truth)
        for name, model in classifiers.items()
    }
