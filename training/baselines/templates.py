"""Template matching: the class of the nearest training crop by the features of a frozen backbone.

A crop has the class of the template whose features have the largest cosine similarity. The backbone reads the colours
of the masked crop.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks import model_arrays, model_from_arrays
from training.baselines.baseline import FitTask, Predictor
from training.baselines.files import StoredBaseline, baseline_file, read_baseline
from training.baselines.image_network import crop_function, read_samples
from training.baselines.networks.architectures import ARCHITECTURES, load_weights, network_inputs
from training.baselines.networks.vit import VIT_DINOV2_SMALL, ViT
from training.views.crops import ViewCrops

__all__ = ["BACKBONES", "DINOV2", "backbone_size", "compare", "create_backbone", "fit_templates", "load_templates"]

SHARPNESS = 20.0
"""Factor of the similarities before the softmax."""


DINOV2 = "vit_small_patch14_dinov2"
"""File of DINOv2's weights, without the suffix."""

DINOV2_SIZE = 224

BACKBONES = (DINOV2, "rgbd-vit", "rgbd-vit-small")
"""DINOv2 from a file of weights, or the colour stream of a network that was trained on the same views."""


def create_backbone(source: str) -> ViT:
    """Return a backbone of BACKBONES with random weights."""
    if source == DINOV2:
        return ViT(VIT_DINOV2_SMALL, DINOV2_SIZE, rngs=nnx.Rngs(0))
    return ARCHITECTURES[source].create(1, rngs=nnx.Rngs(0)).color


def backbone_size(source: str) -> int:
    """Return the side of the images that a backbone reads, pixels."""
    return DINOV2_SIZE if source == DINOV2 else ARCHITECTURES[source].size


def _color(color: Any, normals: Any) -> tuple[jax.Array]:
    return network_inputs(color, normals)[:1]


def _unit(features: jax.Array) -> jax.Array:
    return features / jnp.linalg.norm(features, axis=1, keepdims=True)


def load_templates(arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Return the comparison with templates: equal probabilities for padding rows.

    Raises:
        KeyError, ValueError: an array is missing or has another shape.
    """
    name, n_classes = BACKBONES[int(arrays["number"][0])], len(run.classes)
    embed = crop_function(model_from_arrays(partial(create_backbone, name), arrays, "backbone/"), _color, _unit)
    features, label = arrays["features"], arrays["label"]

    def predict(crops: ViewCrops) -> NDArray[np.float32]:
        return compare(embed(crops), features, label, n_classes)

    return lambda inputs: inputs.predicted(backbone_size(name), n_classes, predict)


def compare(
    features: NDArray[np.float32], stored: NDArray[np.float16], label: NDArray[np.int16], n_classes: int
) -> NDArray[np.float32]:
    """Return class probabilities [V, C] for unit features [V, D]: a softmax of the largest similarities.

    Args:
        features: the features.
        stored: [T, D] unit features of the templates.
        label: [T] their classes; every class has a template.
        n_classes: number of classes.
    """
    similarity = features @ stored.astype(np.float32).T
    nearest = np.stack([similarity[:, label == c].max(axis=1) for c in range(n_classes)], axis=1)
    return np.asarray(jax.nn.softmax(SHARPNESS * nearest, axis=1))


def _backbone(task: FitTask) -> tuple[int, ViT, Mapping[str, str]]:
    """Return the number of the backbone, the backbone, and the digests of its files of weights.

    Raises:
        InputError: there is no backbone, or its file cannot be used.
    """
    if task.weights is not None:
        model = create_backbone(DINOV2)
        return BACKBONES.index(DINOV2), model, load_weights(task.weights, [(model, DINOV2)])
    for number, name in enumerate(BACKBONES):
        file = baseline_file(task.directory, name)
        if file.is_file():
            stored = read_baseline(file, task.source.classes)
            create = partial(ARCHITECTURES[name].build, len(task.source.classes), 0)
            network: Any = model_from_arrays(create, stored.arrays)
            return number, network.color, stored.weights
    raise InputError(
        f"baselines: templates needs a backbone; expected --weights with {DINOV2}.safetensors, or the "
        "baseline rgbd-vit or rgbd-vit-small in the same run"
    )


def fit_templates(task: FitTask) -> StoredBaseline:
    """Store the features of all crops that are not held out.

    Raises:
        InputError: there is no backbone, or the source has no crops.
    """
    number, model, weights = _backbone(task)
    crops, label, view = read_samples(task, backbone_size(BACKBONES[number]))
    held_out = task.held_out(label, view)
    features = crop_function(model, _color, _unit)(crops)
    task.progress("collect templates", 1, 1, f"{len(features)} crops")
    stored = features[~held_out].astype(np.float16), label[~held_out].astype(np.int16)
    n_classes = len(task.source.classes)
    temperature = task.temperature(label, held_out, lambda: compare(features[held_out], *stored, n_classes))
    arrays = model_arrays(model, "backbone/")
    arrays |= {"number": np.array([number]), "features": stored[0], "label": stored[1]}
    return StoredBaseline(arrays, temperature, weights)
