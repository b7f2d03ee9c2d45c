"""Fitting an image network: AdamW on cross-entropy, with a cosine schedule and a checkpoint for each epoch."""

import dataclasses
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.files import file_digest
from training.baselines.image_network import ImageNetwork
from training.baselines.networks.architectures import ARCHITECTURES
from training.baselines.networks.inputs import network_inputs
from training.baselines.networks.weights import load_backbone
from training.baselines.pretrained import weights_file
from training.baselines.task import FitTask, FittedBaseline
from training.fitting.checkpoints import Checkpoints
from training.fitting.loop import Steps, run_epochs
from training.views.view_crops import ViewCrops

__all__ = ["CropSamples", "fit_network", "read_samples"]

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


def read_samples(task: FitTask, name: str, size: int) -> CropSamples:
    """Read the crops of all views into memory, 6 bytes for each of their pixels.

    Raises:
        InputError: the source has no crops, or smaller ones.
    """
    total = sum(shard.views for shard in task.source.shards)
    crops = ViewCrops(np.zeros((total, size, size, 3), np.uint8), np.zeros((total, size, size, 3), np.int8))
    label, view = np.zeros(total, np.int32), np.zeros(total, np.int32)
    row = 0
    for index, shard in enumerate(task.source.shards):
        read = task.source.read_crops(index, size)
        rows = slice(row, row + len(read))
        crops.color[rows], crops.normals[rows] = read.color, read.normals
        label[rows], view[rows] = shard.label, task.source.read(index).view
        row += len(read)
        task.progress(f"read for {name}", row, total, "crops")
    return CropSamples(crops, label, view)


class _State(NamedTuple):
    params: Any
    statistics: Any
    optimizer: Any


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def _step(graph: Any, state: _State, color: Any, normals: Any, label: Any, rate: Any) -> Any:
    def loss_of(params: Any) -> Any:
        model = nnx.merge(graph, params, state.statistics, copy=True)  # batch normalizations change their statistics
        logits = model(*network_inputs(color, normals))
        loss = optax.softmax_cross_entropy_with_integer_labels(logits, label).mean()
        return loss, (nnx.state(model, nnx.BatchStat), (logits.argmax(axis=1) == label).mean())

    (loss, (statistics, accuracy)), gradients = jax.value_and_grad(loss_of, has_aux=True)(state.params)
    updates, optimizer = _optimizer(rate).update(gradients, state.optimizer, state.params)
    return _State(optax.apply_updates(state.params, updates), statistics, optimizer), loss, accuracy


def _optimizer(rate: Any) -> Any:
    return optax.adamw(rate, weight_decay=WEIGHT_DECAY)


def _learning_rate(highest: float, progress: float) -> np.float32:
    """Return the rate at a progress from 0 to 1."""
    if progress < WARM_UP:
        return np.float32(highest * progress / WARM_UP)
    return np.float32(highest * (1 + np.cos(np.pi * (progress - WARM_UP) / (1 - WARM_UP))) / 2)


def _mirrored(crops: ViewCrops, rng: np.random.Generator) -> ViewCrops:
    """Return a copy of the crops, mirrored at random along x, with the x of the normals."""
    flip = rng.random(len(crops)) < 0.5
    color, normals = crops.color.copy(), crops.normals.copy()
    color[flip], normals[flip] = color[flip, :, ::-1], normals[flip, :, ::-1] * np.array([-1, 1, 1], np.int8)
    return ViewCrops(color, normals)


def fit_network(task: FitTask, name: str) -> FittedBaseline:
    """Fit a network of `ARCHITECTURES`; an interrupted fit resumes after its last epoch.

    An epoch uses as many crops as there are views, drawn from all their copies, each mirrored at random.

    Raises:
        InputError: the source has no crops, a file of weights does not fit, or the loss is not finite.
    """
    architecture = ARCHITECTURES[name]
    n_classes = len(task.source.classes)
    model: Any = architecture.build(n_classes, task.options.seed)
    weights = {}
    if task.weights is not None:
        for backbone, file in architecture.weights.items():
            path = weights_file(task.weights, file)
            load_backbone(getattr(model, backbone), path)
            weights[path.name] = file_digest(path)
    samples = read_samples(task, name, architecture.size)
    held_out = task.held_out(samples.label, samples.view)
    rate = PRETRAINED_RATE if weights else SCRATCH_RATE
    fitted = ImageNetwork(name, _fit(task, name, model, samples, np.flatnonzero(~held_out), rate), n_classes)
    return FittedBaseline(fitted, fitted.predict(samples.rows(held_out)), samples.label[held_out], weights)


def _fit(
    task: FitTask, name: str, model: nnx.Module, samples: CropSamples, rows: NDArray[np.intp], highest: float
) -> nnx.Module:
    """Fit the network on the crops of these rows."""
    n_views = len(np.unique(np.stack([samples.label[rows], samples.view[rows]]), axis=1).T)
    epochs, batch_size = task.options.epochs, min(BATCH_SIZE, n_views)
    steps = Steps(epochs, n_views // batch_size, batch_size)
    model.train()
    split: Any = nnx.split(model, nnx.Param, nnx.BatchStat)
    graph, params, statistics = split
    leaves, structure = jax.tree.flatten(_State(params, statistics, _optimizer(0.0).init(params)))

    def epoch(number: int) -> Iterator[tuple[ViewCrops, NDArray[np.int32]]]:
        rng = np.random.default_rng((task.options.seed, number - 1))
        order = rng.permutation(rows)[: steps.of_epoch * batch_size]
        for batch in order.reshape(-1, batch_size):
            yield _mirrored(samples.rows(batch), rng), samples.label[batch]

    def step(leaves: list[Any], number: int, batch: tuple[ViewCrops, NDArray[np.int32]]) -> tuple[list[Any], Any]:
        crops, label = batch
        rate = _learning_rate(highest, (number + 0.5) / (epochs * steps.of_epoch))
        state, *metrics = _step(graph, jax.tree.unflatten(structure, leaves), crops.color, crops.normals, label, rate)
        return jax.tree.leaves(state), metrics

    with Checkpoints(task.scratch / ("pretrained" if highest == PRETRAINED_RATE else "scratch")) as checkpoints:
        leaves = run_epochs(name, leaves, steps, epoch, step, checkpoints, progress=task.report(name))
    state = jax.tree.unflatten(structure, leaves)
    return nnx.merge(graph, state.params, state.statistics)
