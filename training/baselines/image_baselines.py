"""Baselines on crops: image networks, and the nearest template by the features of a frozen backbone.

A crop has the class of the template whose features have the largest cosine similarity. The backbone of the templates
reads the colours of the masked crop.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import model_arrays, model_from_arrays
from training.baselines.architectures import ARCHITECTURES, TEMPLATES, network_inputs
from training.baselines.baseline import FitTask, Predictor, StoredBaseline, baseline_file, compiled_network, in_batches
from training.views.crops import ViewCrops

__all__ = ["check_backbone", "fit_image_network", "fit_templates", "load_image_network", "load_templates"]

INFERENCE_BATCH = 8
"""Number of crops that a network reads at a time, about the instances of a frame, so that one program is compiled."""


def _crop_function(
    model: nnx.Module,
    inputs: Callable[..., tuple[Any, ...]] = network_inputs,
    output: Callable[[Any], Any] = jax.nn.softmax,
) -> Callable[[ViewCrops], NDArray[np.float32]]:
    """Return a function of V >= 1 crops that returns `output` [V, ...] of the network applied to their `inputs`."""
    model.eval()
    function = compiled_network(model, inputs, output)
    return lambda crops: in_batches(function, INFERENCE_BATCH, crops.color, crops.normals)


def load_image_network(name: str, arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Build a network of `ARCHITECTURES` from its weights; padding rows get uniform probabilities.

    Raises:
        ValueError: an array is missing or has another shape.
    """
    architecture, n_classes = ARCHITECTURES[name], len(run.classes)
    predict = _crop_function(model_from_arrays(lambda: architecture.build(n_classes, 0), arrays))
    return lambda inputs: inputs.predicted(architecture.size, n_classes, predict)


BATCH_SIZE = 32

SCRATCH_RATE, PRETRAINED_RATE = 1e-3, 1e-4
"""Highest learning rates, without and with pretrained weights."""

WARM_UP = 0.05
"""Fraction of the steps in which the learning rate increases."""

OPTIMIZER = partial(optax.adamw, weight_decay=0.05)


def _read_samples(task: FitTask, size: int) -> tuple[ViewCrops, NDArray[np.int32], NDArray[np.int32]]:
    """Return the crops, class indices and view numbers of all views; a crop needs 6 bytes per pixel of memory.

    Raises:
        InputError: the source has no crops, or only smaller crops.
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
    """Return the learning rate of a step, which first increases and then decays along a cosine."""
    progress = (number + 0.5) / n_steps
    if progress < WARM_UP:
        return highest * progress / WARM_UP
    return float(highest * (1 + np.cos(np.pi * (progress - WARM_UP) / (1 - WARM_UP))) / 2)


def fit_image_network(task: FitTask) -> StoredBaseline:
    """Fit a network of `ARCHITECTURES`; an interrupted fit resumes after its last epoch.

    An epoch uses as many crops as there are views. They are drawn from all copies of the views and randomly mirrored.

    Raises:
        InputError: the source has no crops, a weights file does not match the network, or the loss is not finite.
    """
    architecture = ARCHITECTURES[task.name]
    model: Any = architecture.build(len(task.source.classes), task.options.seed)
    weights = {} if task.weights is None else architecture.load_weights(model, task.weights)
    samples, label, view = _read_samples(task, architecture.size)
    held_out = task.held_out(label, view)
    directory, rate = ("-".join(weights.values()), PRETRAINED_RATE) if weights else ("scratch", SCRATCH_RATE)
    n_views = len(np.unique(np.stack([label, view])[:, ~held_out], axis=1).T)

    def draw(rows: NDArray[np.intp], rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.int8]]:
        """Return copies of colour and normals, mirrored at random along x, with the x of the normals."""
        color, normals, flip = samples.color[rows], samples.normals[rows], rng.random(len(rows)) < 0.5
        color[flip] = color[flip, :, ::-1]
        normals[flip] = normals[flip, :, ::-1] * np.array([-1, 1, 1], np.int8)
        return color, normals

    model.train()
    fit = partial(task.fit_network, inputs=network_inputs, n_samples=n_views, directory=directory)
    fitted = fit(model, label, held_out, draw, OPTIMIZER, partial(_learning_rate, rate), BATCH_SIZE)
    predict = _crop_function(fitted)
    held = ViewCrops(samples.color[held_out], samples.normals[held_out])
    temperature = task.temperature(label, held_out, lambda: predict(held))
    return StoredBaseline(model_arrays(fitted), temperature, weights)


SHARPNESS = 20.0
"""Factor of the similarities before the softmax."""

NO_BACKBONE = (
    f"baselines: templates needs a backbone; expected --weights with {ARCHITECTURES[TEMPLATES].weights['color']}"
    ".safetensors, or the baseline rgbd-vit or rgbd-vit-small in the same run"
)

TRAINED = ("rgbd-vit", "rgbd-vit-small")
BACKBONES = (TEMPLATES, *TRAINED)
"""DINOv2 from a file of weights, or the colour stream of a network that was trained on the same views."""


def _color(color: Any, normals: Any) -> tuple[jax.Array]:
    return network_inputs(color, normals)[:1]


def _unit(features: jax.Array) -> jax.Array:
    return features / jnp.linalg.norm(features, axis=1, keepdims=True)


def load_templates(arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Build the predictor that compares with templates; padding rows get uniform probabilities.

    Raises:
        KeyError, ValueError: an array is missing or has another shape.
    """
    name, n_classes = BACKBONES[int(arrays["number"][0])], len(run.classes)
    architecture = ARCHITECTURES[name]
    model = model_from_arrays(lambda: architecture.build(n_classes, 0).color, arrays, "backbone/")
    embed = _crop_function(model, _color, _unit)
    features, label = arrays["features"], arrays["label"]

    def predict(crops: ViewCrops) -> NDArray[np.float32]:
        return compare(embed(crops), features, label, n_classes)

    return lambda inputs: inputs.predicted(architecture.size, n_classes, predict)


def compare(
    features: NDArray[np.float32], stored: NDArray[np.float16], label: NDArray[np.int16], n_classes: int
) -> NDArray[np.float32]:
    """Return class probabilities [V, C] for unit features [V, D]: a softmax of the largest similarities.

    Args:
        features: the features.
        stored: [T, D] unit features of the templates.
        label: [T] classes of the templates; every class has a template.
        n_classes: number of classes.
    """
    similarity = features @ stored.astype(np.float32).T
    nearest = np.stack([similarity[:, label == c].max(axis=1) for c in range(n_classes)], axis=1)
    return np.asarray(jax.nn.softmax(SHARPNESS * nearest, axis=1))


def _backbone(task: FitTask) -> tuple[int, nnx.Module, Mapping[str, str]]:
    """Return the number of the backbone, the backbone, and the digests of its weights files.

    Raises:
        InputError: there is no backbone, or its file cannot be used.
    """
    if task.weights is not None:
        architecture = ARCHITECTURES[TEMPLATES]
        network = architecture.build(1, 0)
        return 0, network.color, architecture.load_weights(network, task.weights)
    for number, name in enumerate(TRAINED, 1):
        if (file := baseline_file(task.directory, name)).is_file():
            stored = StoredBaseline.read(file, task.source.classes)
            network = model_from_arrays(partial(ARCHITECTURES[name].build, len(task.source.classes), 0), stored.arrays)
            return number, network.color, stored.weights
    raise InputError(NO_BACKBONE)


def fit_templates(task: FitTask) -> StoredBaseline:
    """Compute the features of all crops that are not held out, as templates.

    Raises:
        InputError: there is no backbone, or the source has no crops.
    """
    number, model, weights = _backbone(task)
    crops, label, view = _read_samples(task, ARCHITECTURES[BACKBONES[number]].size)
    held_out = task.held_out(label, view)
    features = _crop_function(model, _color, _unit)(crops)
    task.progress("collect templates", 1, 1, f"{len(features)} crops")
    stored = features[~held_out].astype(np.float16), label[~held_out].astype(np.int16)
    n_classes = len(task.source.classes)
    temperature = task.temperature(label, held_out, lambda: compare(features[held_out], *stored, n_classes))
    arrays = model_arrays(model, "backbone/")
    arrays |= {"number": np.array([number]), "features": stored[0], "label": stored[1]}
    return StoredBaseline(arrays, temperature, weights)


def check_backbone(names: Sequence[str], out: Path) -> None:
    """Raise InputError if templates without pretrained weights have no backbone in `names` or in the runs in `out`.

    Runs that have templates need none.
    """
    files = [baseline_file(Path(), name) for name in BACKBONES]
    if TEMPLATES in names and not set(TRAINED) & set(names) and not any(any(out.rglob(str(file))) for file in files):
        raise InputError(NO_BACKBONE)
