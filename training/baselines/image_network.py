"""A trained image network as a baseline."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.model.classifier import model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs
from training.baselines.networks.architectures import ARCHITECTURES
from training.baselines.networks.inputs import network_inputs
from training.views.view_crops import ViewCrops

__all__ = ["ImageNetwork", "in_batches"]

INFERENCE_BATCH = 8
"""Crops that a network reads at a time, about the instances of a frame: one compiled program for all."""


@partial(jax.jit, static_argnums=0)
def _probabilities(graph: Any, state: Any, color: Any, normals: Any) -> jax.Array:
    return jax.nn.softmax(nnx.merge(graph, state)(*network_inputs(color, normals)))


def in_batches(function: Any, crops: ViewCrops) -> NDArray[np.float32]:
    """Return the results [V, ...] of a function of `INFERENCE_BATCH` colour and normal images; V is at least 1."""
    results = []
    for first in range(0, len(crops), INFERENCE_BATCH):
        rows = np.resize(np.arange(first, min(first + INFERENCE_BATCH, len(crops))), INFERENCE_BATCH)
        results.append(np.asarray(function(crops.color[rows], crops.normals[rows]))[: len(crops) - first])
    return np.concatenate(results)


class ImageNetwork:
    """A trained network of `ARCHITECTURES`."""

    def __init__(self, name: str, model: nnx.Module, n_classes: int) -> None:
        """Store the network called `name`."""
        model.eval()
        self._model, self._size, self._n_classes = model, ARCHITECTURES[name].size, n_classes
        self._graph, self._state = nnx.split(model)

    @property
    def model(self) -> nnx.Module:
        """The network, in evaluation mode."""
        return self._model

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the weights and batch statistics by their paths."""
        return model_arrays(self._model)

    @classmethod
    def with_arrays(cls, name: str, arrays: Mapping[str, NDArray[Any]], n_classes: int) -> "ImageNetwork":
        """Build the network called `name` from `arrays`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        return cls(name, model_from_arrays(lambda: ARCHITECTURES[name].build(n_classes, 0), arrays), n_classes)

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities [B, C]; equal ones for padding rows."""
        values = np.full((len(inputs.tops), self._n_classes), 1 / self._n_classes, np.float32)
        crops = inputs.crops(self._size)
        values[: len(crops)] = self.predict(crops)
        return values

    def predict(self, crops: ViewCrops) -> NDArray[np.float32]:
        """Return class probabilities [V, C] of crops of the network's size."""
        if not len(crops):
            return np.zeros((0, self._n_classes), np.float32)
        return in_batches(partial(_probabilities, self._graph, self._state), crops)
