"""A trained image network as a baseline."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks import model_arrays, model_from_arrays
from training.baselines.baseline import FitTask, NetworkFit, Predictor, compiled_network, fit_network, in_batches
from training.baselines.files import StoredBaseline
from training.baselines.networks.architectures import ARCHITECTURES, load_weights, network_inputs
from training.views.crops import ViewCrops

__all__ = ["crop_function", "fit_image_network", "load_image_network", "read_samples", "rows_of"]

INFERENCE_BATCH = 8
"""Crops that a network reads at a time, about the instances of a frame: one compiled program for all."""


def crop_function(
    model: nnx.Module,
    inputs: Callable[..., tuple[Any, ...]] = network_inputs,
    output: Callable[[Any], Any] = jax.nn.softmax,
) -> Callable[[ViewCrops], NDArray[np.float32]]:
    """Return a function of V crops, at least 1: `output` [V, ...] of a network that is applied to `inputs` of them."""
    model.eval()
    function = compiled_network(model, inputs, output)
    return lambda crops: in_batches(function, INFERENCE_BATCH, crops.color, crops.normals)


def load_image_network(name: str, arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Return the network of `ARCHITECTURES` called `name` of its weights; equal probabilities for padding rows.

    Raises:
        ValueError: an array is missing or has another shape.
    """
    architecture, n_classes = ARCHITECTURES[name], len(run.classes)
    predict = crop_function(model_from_arrays(lambda: architecture.build(n_classes, 0), arrays))
    return lambda inputs: inputs.predicted(architecture.size, n_classes, predict)


BATCH_SIZE = 32

SCRATCH_RATE, PRETRAINED_RATE = 1e-3, 1e-4
"""Highest learning rates, without and with pretrained weights."""

WARM_UP = 0.05
"""Fraction of the steps in which the learning rate rises."""

OPTIMIZER = partial(optax.adamw, weight_decay=0.05)


def rows_of(crops: ViewCrops, rows: Any) -> ViewCrops:
    """Return the crops of some rows."""
    return ViewCrops(crops.color[rows], crops.normals[rows])


def read_samples(task: FitTask, size: int) -> tuple[ViewCrops, NDArray[np.int32], NDArray[np.int32]]:
    """Return the crops, class indices and view numbers of all views, with 6 bytes for each pixel of a crop.

    Raises:
        InputError: the source has no crops, or smaller ones.
    """
    shape = task.n_clouds, size, size, 3
    crops = ViewCrops(np.zeros(shape, np.uint8), np.zeros(shape, np.int8))
    label, view = np.zeros((2, task.n_clouds), np.int32)
    for index, rows, views in task.shards(f"read for {task.name}", "crops"):
        read = task.source.read_crops(index, size)
        crops.color[rows], crops.normals[rows] = read.color, read.normals
        label[rows], view[rows] = views.label, views.view
    return crops, label, view


def _learning_rate(highest: float, number: int, n_steps: int) -> float:
    """Return the learning rate of a step: it rises, and falls along a cosine."""
    progress = (number + 0.5) / n_steps
    if progress < WARM_UP:
        return highest * progress / WARM_UP
    return float(highest * (1 + np.cos(np.pi * (progress - WARM_UP) / (1 - WARM_UP))) / 2)


def fit_image_network(task: FitTask) -> StoredBaseline:
    """Fit a network of `ARCHITECTURES`; an interrupted fit resumes after its last epoch.

    An epoch uses as many crops as there are views, drawn from all their copies, each mirrored at random.

    Raises:
        InputError: the source has no crops, a file of weights does not fit, or the loss is not finite.
    """
    architecture = ARCHITECTURES[task.name]
    model: Any = architecture.build(len(task.source.classes), task.options.seed)
    weights = {} if task.weights is None else load_weights(task.weights, architecture.backbones(model))
    samples, label, view = read_samples(task, architecture.size)
    held_out = task.held_out(label, view)
    directory, rate = ("pretrained", PRETRAINED_RATE) if weights else ("scratch", SCRATCH_RATE)
    n_views = len(np.unique(np.stack([label, view])[:, ~held_out], axis=1).T)

    def draw(rows: NDArray[np.intp], rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
        """Return copies of colour and normals, mirrored at random along x, with the x of the normals."""
        crops, flip = rows_of(samples, rows), rng.random(len(rows)) < 0.5  # fancy indices copy
        crops.color[flip] = crops.color[flip, :, ::-1]
        crops.normals[flip] = crops.normals[flip, :, ::-1] * np.array([-1, 1, 1], np.int8)
        return crops.color, crops.normals

    model.train()
    fit = NetworkFit(directory, draw, network_inputs, BATCH_SIZE, OPTIMIZER, partial(_learning_rate, rate))
    fitted = fit_network(task, fit, model, label, np.flatnonzero(~held_out), n_views)
    predict = crop_function(fitted)
    temperature = task.temperature(label, held_out, lambda: predict(rows_of(samples, held_out)))
    return StoredBaseline(model_arrays(fitted), temperature, weights)
