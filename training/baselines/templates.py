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
from thor2_jax.files import file_digest
from thor2_jax.model.classifier import model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs, FitTask, FittedBaseline, in_batches
from training.baselines.files import baseline_file, read_baseline
from training.baselines.image_network import INFERENCE_BATCH, ImageNetwork, read_samples
from training.baselines.networks.architectures import ARCHITECTURES, load_weights, network_inputs
from training.baselines.networks.vit import VIT_DINOV2_SMALL, ViT
from training.views.crops import ViewCrops

__all__ = ["BACKBONES", "DINOV2", "Templates", "create_backbone", "fit_templates"]

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
    network: Any = ARCHITECTURES[source].build(1, 0)
    stream: ViT = network.color
    return stream


def backbone_size(source: str) -> int:
    """Return the side of the images that a backbone reads, pixels."""
    return DINOV2_SIZE if source == DINOV2 else ARCHITECTURES[source].size


@partial(jax.jit, static_argnums=0)
def _features(graph: Any, state: Any, color: Any, normals: Any) -> jax.Array:
    features = nnx.merge(graph, state)(network_inputs(color, normals)[0])
    return features / jnp.linalg.norm(features, axis=1, keepdims=True)


class Templates:
    """Templates of all classes and the backbone that compares them."""

    def __init__(
        self, number: int, model: ViT, features: NDArray[np.float16], label: NDArray[np.int16], n_classes: int
    ) -> None:
        """Store the templates.

        Args:
            number: index of the backbone in BACKBONES.
            model: the backbone.
            features: [T, D] float16, unit features of the templates.
            label: [T] their classes; every class has a template.
            n_classes: number of classes.
        """
        model.eval()
        self._number, self._model, self._stored, self._label = number, model, features, label
        self._n_classes, self._features = n_classes, partial(_features, *nnx.split(model))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the weights of the backbone as `backbone/<path>`, and the templates."""
        weights = {f"backbone/{path}": array for path, array in model_arrays(self._model).items()}
        return {**weights, "number": np.array([self._number]), "features": self._stored, "label": self._label}

    @classmethod
    def with_arrays(cls, arrays: Mapping[str, NDArray[Any]], n_classes: int) -> "Templates":
        """Build the templates from `arrays`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        missing = {"number", "features", "label"} - set(arrays)
        if missing:
            raise ValueError(f"{min(missing)} is missing")
        number = int(arrays["number"][0])
        if not 0 <= number < len(BACKBONES):
            raise ValueError(f"number is {number}")
        weights = {k.removeprefix("backbone/"): a for k, a in arrays.items() if k.startswith("backbone/")}
        model = model_from_arrays(partial(create_backbone, BACKBONES[number]), weights)
        return cls(number, model, arrays["features"], arrays["label"], n_classes)

    def embed(self, crops: ViewCrops) -> NDArray[np.float32]:
        """Return the unit features [V, D] of crops of the backbone's size; V is at least 1."""
        return in_batches(self._features, INFERENCE_BATCH, crops.color, crops.normals)

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities [B, C]; equal ones for padding rows."""
        size = backbone_size(BACKBONES[self._number])
        return inputs.predicted(size, self._n_classes, lambda crops: self.compare(self.embed(crops)))

    def compare(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return class probabilities [V, C] for unit features [V, D]: a softmax of the largest similarities."""
        similarity = features @ self._stored.astype(np.float32).T
        nearest = np.stack([similarity[:, self._label == c].max(axis=1) for c in range(self._n_classes)], axis=1)
        return np.asarray(jax.nn.softmax(SHARPNESS * nearest, axis=1))


def _backbone(task: FitTask) -> tuple[int, ViT, dict[str, str]]:
    """Return the number of the backbone, the backbone, and the digests of its files of weights.

    Raises:
        InputError: there is no backbone, or its file cannot be used.
    """
    if task.weights is not None:
        model = create_backbone(DINOV2)
        (path,) = load_weights(task.weights, [(model, DINOV2)])
        return BACKBONES.index(DINOV2), model, {path.name: file_digest(path)}
    for number, name in enumerate(BACKBONES):
        file = baseline_file(task.directory, name)
        if file.is_file():
            stored = read_baseline(file, task.source.classes)
            network = ImageNetwork.with_arrays(name, stored.arrays, len(task.source.classes))
            return number, network.model.color, dict(stored.weights)  # type: ignore[attr-defined]
    raise InputError(
        f"baselines: templates needs a backbone; expected --weights with {DINOV2}.safetensors, or the "
        "baseline rgbd-vit or rgbd-vit-small in the same run"
    )


def fit_templates(task: FitTask) -> FittedBaseline:
    """Store the features of all crops that are not held out.

    Raises:
        InputError: there is no backbone, or the source has no crops.
    """
    number, model, weights = _backbone(task)
    n_classes = len(task.source.classes)
    samples = read_samples(task, backbone_size(BACKBONES[number]))
    held_out = task.held_out(samples.label, samples.view)
    untaught = Templates(number, model, np.zeros((0, 0), np.float16), np.zeros(0, np.int16), n_classes)
    features = untaught.embed(samples.crops)
    task.progress("collect templates", 1, 1, f"{len(features)} crops")
    stored = features[~held_out].astype(np.float16)
    templates = Templates(number, model, stored, samples.label[~held_out].astype(np.int16), n_classes)
    temperature = task.temperature(samples.label, held_out, lambda: templates.compare(features[held_out]))
    return FittedBaseline(templates, temperature, weights)
