"""Baselines on crops: image networks, and the nearest template by the features of a frozen backbone.

A crop has the class of the template whose features have the largest cosine similarity. The backbone of the templates
reads the colours of the masked crop.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
import safetensors
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError, decoding
from thor2_jax.files import file_digest
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import model_arrays, model_from_arrays
from training.baselines import image_networks as networks
from training.baselines.baseline import FitTask, Predictor, StoredBaseline, baseline_file, compiled_network, in_batches
from training.views.crops import ViewCrops

__all__ = [
    "ARCHITECTURES",
    "TEMPLATES",
    "check_backbone",
    "fit_image_network",
    "fit_templates",
    "load_image_network",
    "load_templates",
]

_TENSORS = {"kernel": "weight", "scale": "weight", "mean": "running_mean", "var": "running_var"}
"""Last part of an NNX path -> last part of the tensor's name."""


def tensors(model: nnx.Module) -> Iterator[tuple[str, tuple[int, ...], str, Any]]:
    """Yield the tensors of a backbone's file: name, shape, and the last name and the variable in the network.

    The last two axes of kernels are the first ones of the tensor, reversed.
    """
    prefix: str = getattr(model, "PREFIX", "")
    for path, variable in nnx.to_flat_state(nnx.state(model, (nnx.Param, nnx.BatchStat))):
        *modules, kind = map(str, path)
        shape = variable.shape
        if kind == "kernel":
            shape = (shape[-1], shape[-2], *shape[:-2])
        yield prefix + ".".join([*modules, _TENSORS.get(kind, kind)]), shape, kind, variable


def load_backbone(model: nnx.Module, path: Path) -> None:
    """Replace the weights of a backbone by weights from a safetensors file, ignoring other tensors in the file.

    The file has the tensor names of timm: `layer1.0.conv1.weight` is the kernel of `model.layer1[0].conv1`. The
    positions of a ViT are resampled to the grid of the model.

    Raises:
        InputError: the file is missing or damaged, or a tensor is missing or has another shape.
    """
    parameters, advice = list(tensors(model)), "give the file of the network's backbone"
    with decoding(f"weights: {path} cannot be read", "a safetensors file, see docs/baselines.md"):
        with safetensors.safe_open(path, "numpy") as file:
            wanted_names = {name for name, *_ in parameters}.intersection(file.keys())
            arrays = {name: file.get_tensor(name).astype(np.float32) for name in wanted_names}
    for name, wanted, kind, variable in parameters:
        if name not in arrays:
            raise InputError(f"weights: {path} has no tensor {name}; expected one of shape {wanted}: {advice}")
        array = resampled_positions(arrays[name], wanted) if kind == "pos_embed" else arrays[name]
        if array.shape != wanted:
            raise InputError(f"weights: {name} in {path} has the shape {array.shape}; expected {wanted}: {advice}")
        axes = (*range(2, array.ndim), 1, 0) if kind == "kernel" else range(array.ndim)
        variable.set_value(jnp.asarray(array.transpose(*axes)))


def resampled_positions(positions: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Resample the positions [1, 1 + G*G, D] of a ViT to another square grid, with bicubic interpolation as in timm.

    Positions of another length D, or of a grid that is not square, are returned unchanged.
    """
    sides = [round((n - 1) ** 0.5) for n in (positions.shape[1], shape[1])] if positions.ndim == 3 else [0, 0]
    square = positions.ndim == 3 and sides[0] ** 2 + 1 == positions.shape[1]
    if positions.shape == shape or not square or positions.shape[2] != shape[2]:
        return positions
    grid = positions[0, 1:].reshape(sides[0], sides[0], -1)
    resized = jax.image.resize(grid, (sides[1], sides[1], grid.shape[2]), "cubic")
    return np.concatenate([positions[0, :1], np.asarray(resized).reshape(sides[1] ** 2, -1)])[None]


@dataclasses.dataclass(frozen=True)
class Architecture:
    """An image network.

    Attributes:
        create: function of the number of classes and `rngs` that returns the network.
        size: side of its images, pixels.
        weights: backbone, an attribute of the network -> file of its pretrained weights, without the suffix; backbones
            without a public file are not listed.
    """

    create: Callable[..., Any]
    size: int
    weights: Mapping[str, str]

    def build(self, n_classes: int, seed: int) -> Any:
        """Return the network with random weights."""
        return self.create(n_classes, rngs=nnx.Rngs(seed))

    def load_weights(self, network: Any, directory: Path) -> dict[str, str]:
        """Replace the weights of the backbones of a network by weights from the files in a folder.

        Returns:
            Name of each file -> its SHA-256.

        Raises:
            InputError: a file does not exist; also as `load_backbone`.
        """
        digests = {}
        for backbone, name in self.weights.items():
            path = directory / f"{name}.safetensors"
            if not path.is_file():
                raise InputError(f"weights: {path} does not exist; expected it in the folder, see docs/baselines.md")
            load_backbone(getattr(network, backbone), path)
            digests[path.name] = file_digest(path)
        return digests


TEMPLATES = "templates"
"""The nearest template by features of a frozen backbone, which may be the backbone of a network of the same run."""


def _dinov2(n_classes: int, *, rngs: nnx.Rngs) -> Any:
    return nnx.Dict(color=networks.ViT(networks.VIT_DINOV2_SMALL, _LARGE, rngs=rngs))


_LARGE, _SMALL = 224, 96
_SMALL_DENSENET = {"growth": 12, "blocks": (2, 4, 4, 2)}
_TINY = "vit_tiny_patch16_224"
_STREAMS = ("color", "normals")

ARCHITECTURES: dict[str, Architecture] = {
    "rcfusion": Architecture(
        partial(networks.RCFusion, width=64, projection=512, memory=50), _LARGE, dict.fromkeys(_STREAMS, "resnet18")
    ),
    "rcfusion-small": Architecture(partial(networks.RCFusion, width=16, projection=64, memory=50), _SMALL, {}),
    "vit-cnn": Architecture(
        partial(networks.ViTCNN, vit=networks.VIT_BASE, cnn=networks.DENSENET_161, size=_LARGE),
        _LARGE,
        {"vit": "vit_base_patch16_224.mae", "cnn": "densenet161"},
    ),
    "vit-cnn-small": Architecture(
        partial(networks.ViTCNN, vit=networks.VIT_TINY_4, cnn=_SMALL_DENSENET, size=_SMALL), _SMALL, {"vit": _TINY}
    ),
    "rgbd-vit": Architecture(
        partial(networks.RGBDViT, vit=networks.VIT_BASE, size=_LARGE),
        _LARGE,
        dict.fromkeys(_STREAMS, "vit_base_patch16_224"),
    ),
    "rgbd-vit-small": Architecture(
        partial(networks.RGBDViT, vit=networks.VIT_TINY_4, size=_SMALL), _SMALL, dict.fromkeys(_STREAMS, _TINY)
    ),
    TEMPLATES: Architecture(_dinov2, _LARGE, {"color": "vit_small_patch14_dinov2"}),
}
"""Name of the baseline -> its network; for the templates, the backbone that is read from a file of weights."""


MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
"""Mean and standard deviation of the colours of ImageNet, in [0, 1]."""


def network_inputs(color: Any, normals: Any) -> tuple[jax.Array, jax.Array]:
    """Return network inputs [B, S, S, 3] of colour and of normals for the arrays of `ViewCrops`.

    Normals are colour-coded, (n + 1) / 2. The background is 0 in both, the mean colour of ImageNet.
    """
    mask = jnp.any(normals != 0, axis=-1, keepdims=True)
    images = color.astype(jnp.float32) / 255, (normals.astype(jnp.float32) / 127 + 1) / 2
    first, second = (jnp.where(mask, (image - MEAN) / DEVIATION, 0) for image in images)
    return first, second


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

    `stored` [T, D] are the unit features of the templates and `label` [T] their classes; every class has a template.
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
