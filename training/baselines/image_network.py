"""A trained image network as a baseline."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.files import file_digest
from thor2_jax.model.classifier import model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs, FitTask, FittedBaseline, NetworkFit, fit_network, in_batches
from training.baselines.networks.architectures import ARCHITECTURES, load_weights, network_inputs
from training.views.crops import ViewCrops

__all__ = ["ImageNetwork", "fit_image_network", "read_samples"]

INFERENCE_BATCH = 8
"""Crops that a network reads at a time, about the instances of a frame: one compiled program for all."""


@partial(jax.jit, static_argnums=0)
def _probabilities(graph: Any, state: Any, color: Any, normals: Any) -> jax.Array:
    return jax.nn.softmax(nnx.merge(graph, state)(*network_inputs(color, normals)))


class ImageNetwork:
    """A trained network of `ARCHITECTURES`.

    Attributes:
        model: the network, in evaluation mode.
    """

    def __init__(self, name: str, model: nnx.Module, n_classes: int) -> None:
        """Store the network called `name`."""
        model.eval()
        self.model, self._size, self._n_classes = model, ARCHITECTURES[name].size, n_classes
        self._probabilities = partial(_probabilities, *nnx.split(model))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the weights and batch statistics by their paths."""
        return model_arrays(self.model)

    @classmethod
    def with_arrays(cls, name: str, arrays: Mapping[str, NDArray[Any]], n_classes: int) -> "ImageNetwork":
        """Build the network called `name` from `arrays`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        return cls(name, model_from_arrays(lambda: ARCHITECTURES[name].build(n_classes, 0), arrays), n_classes)

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities [B, C]; equal ones for padding rows."""
        return inputs.predicted(self._size, self._n_classes, self.predict)

    def predict(self, crops: ViewCrops) -> NDArray[np.float32]:
        """Return class probabilities [V, C] of crops of the network's size; V is at least 1."""
        return in_batches(self._probabilities, INFERENCE_BATCH, crops.color, crops.normals)


BATCH_SIZE = 32

SCRATCH_RATE, PRETRAINED_RATE = 1e-3, 1e-4
"""Highest learning rates, without and with pretrained weights."""

WARM_UP = 0.05
"""Fraction of the steps in which the learning rate rises."""

WEIGHT_DECAY = 0.05


@dataclasses.dataclass(frozen=True)
class CropSamples:
    """The crops of all clouds of a source.

    Attributes:
        crops: V crops.
        label: [V] class indices.
        view: [V] view numbers.
    """

    crops: ViewCrops
    label: NDArray[np.int32]
    view: NDArray[np.int32]

    def rows(self, rows: Any) -> ViewCrops:
        """Return the crops of some rows."""
        return ViewCrops(self.crops.color[rows], self.crops.normals[rows])


def read_samples(task: FitTask, size: int) -> CropSamples:
    """Read the crops of all views into memory, 6 bytes for each of their pixels.

    Raises:
        InputError: the source has no crops, or smaller ones.
    """
    shape = task.n_clouds, size, size, 3
    crops = ViewCrops(np.zeros(shape, np.uint8), np.zeros(shape, np.int8))
    label, view = np.zeros(task.n_clouds, np.int32), np.zeros(task.n_clouds, np.int32)
    for index, rows, of_shard in task.shards(f"read for {task.name}", "crops"):
        read = task.source.read_crops(index, size)
        crops.color[rows], crops.normals[rows] = read.color, read.normals
        label[rows], view[rows] = of_shard, task.source.read(index).view
    return CropSamples(crops, label, view)


def _optimizer(rate: Any) -> Any:
    return optax.adamw(rate, weight_decay=WEIGHT_DECAY)


def _learning_rate(highest: float, number: int, n_steps: int) -> float:
    """Return the learning rate of a step: it rises, and falls along a cosine."""
    progress = (number + 0.5) / n_steps
    if progress < WARM_UP:
        return highest * progress / WARM_UP
    return float(highest * (1 + np.cos(np.pi * (progress - WARM_UP) / (1 - WARM_UP))) / 2)


def fit_image_network(task: FitTask) -> FittedBaseline:
    """Fit a network of `ARCHITECTURES`; an interrupted fit resumes after its last epoch.

    An epoch uses as many crops as there are views, drawn from all their copies, each mirrored at random.

    Raises:
        InputError: the source has no crops, a file of weights does not fit, or the loss is not finite.
    """
    architecture = ARCHITECTURES[task.name]
    n_classes = len(task.source.classes)
    model: Any = architecture.build(n_classes, task.options.seed)
    files = [] if task.weights is None else load_weights(task.weights, architecture.backbones(model))
    weights = {path.name: file_digest(path) for path in files}
    samples = read_samples(task, architecture.size)
    held_out = task.held_out(samples.label, samples.view)
    n_views = len(np.unique(np.stack([samples.label, samples.view])[:, ~held_out], axis=1).T)
    directory, rate = ("pretrained", PRETRAINED_RATE) if weights else ("scratch", SCRATCH_RATE)
    schedule = partial(_learning_rate, rate)

    def draw(rows: NDArray[np.intp], rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
        """Return copies of colour and normals, mirrored at random along x, with the x of the normals."""
        crops, flip = samples.rows(rows), rng.random(len(rows)) < 0.5  # fancy indices copy
        crops.color[flip] = crops.color[flip, :, ::-1]
        crops.normals[flip] = crops.normals[flip, :, ::-1] * np.array([-1, 1, 1], np.int8)
        return crops.color, crops.normals

    fit = NetworkFit(directory, draw, network_inputs, BATCH_SIZE, _optimizer, schedule)
    model.train()
    fitted = fit_network(task, fit, model, samples.label, np.flatnonzero(~held_out), n_views)
    network = ImageNetwork(task.name, fitted, n_classes)
    temperature = task.temperature(samples.label, held_out, lambda: network.predict(samples.rows(held_out)))
    return FittedBaseline(network, temperature, weights)
