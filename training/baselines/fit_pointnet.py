"""Fitting the PointNet baseline: Adam on cross-entropy, with a cosine schedule."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from training.baselines.pointnet import POINTS, ColoredPointNet, PointNet, point_features, random_indices
from training.baselines.task import FitTask, FittedBaseline
from training.fitting.checkpoints import Checkpoints
from training.fitting.loop import Steps, run_epochs

__all__ = ["fit_pointnet"]

STORED_POINTS = 2 * POINTS
"""Points stored for each view, so that every epoch can use a different sample of them."""

RATES = 2e-3, 2e-5
"""First and last learning rate of the cosine schedule."""

BATCH_SIZE = 64


class _Views(NamedTuple):
    """V views: [V, STORED_POINTS, 3] points and colours in random order, [V, 3] boxes, [V] labels and view numbers."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    box: NDArray[np.float32]
    label: NDArray[np.int32]
    view: NDArray[np.int32]

    def draw(self, rows: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.float32]:
        """Return network inputs for some views: a random sample of their points, mirrored at random in x and y."""
        first = int(rng.integers(STORED_POINTS - POINTS + 1))
        window = slice(first, first + POINTS)
        x = np.array(point_features(self.xyz[rows, window].astype(np.float32), self.rgb[rows, window], self.box[rows]))
        x[..., :2] *= rng.choice(np.array([-1, 1], np.float32), (len(rows), 1, 2))
        return x


def _read_views(task: FitTask) -> _Views:
    total = sum(shard.views for shard in task.source.shards)
    views = _Views(
        np.zeros((total, STORED_POINTS, 3), np.float16),
        np.zeros((total, STORED_POINTS, 3), np.uint8),
        np.zeros((total, 3), np.float32),
        np.zeros(total, np.int32),
        np.zeros(total, np.int32),
    )
    row = 0
    rng = np.random.default_rng(task.options.seed)
    for index, shard in enumerate(task.source.shards):
        normalized = task.source.read(index)
        for (xyz, rgb), number in zip(normalized.clouds(), normalized.view, strict=True):
            sample = random_indices(len(xyz), STORED_POINTS, rng)
            views.xyz[row], views.rgb[row], views.box[row] = xyz[sample], rgb[sample], xyz.max(axis=0)
            views.label[row], views.view[row] = shard.label, number
            row += 1
        task.progress("read for pointnet", row, total, "views")
    return views


@partial(jax.jit, static_argnums=0, donate_argnums=(1, 2))
def _step(graph: Any, params: Any, optimizer: Any, x: jax.Array, label: jax.Array, rate: Any) -> Any:
    def loss_of(params: Any) -> Any:
        logits = nnx.merge(graph, params)(x)
        loss = optax.softmax_cross_entropy_with_integer_labels(logits, label).mean()
        return loss, (logits.argmax(axis=1) == label).mean()

    (loss, accuracy), gradients = jax.value_and_grad(loss_of, has_aux=True)(params)
    updates, optimizer = optax.adam(rate).update(gradients, optimizer, params)
    return optax.apply_updates(params, updates), optimizer, loss, accuracy


def fit_pointnet(task: FitTask) -> FittedBaseline:
    """Fit a PointNet; an interrupted fit resumes after its last epoch.

    Each epoch uses every view once, with a random sample of points and random mirroring.

    Raises:
        InputError: the loss is not finite.
    """
    views = _read_views(task)
    held_out = task.held_out(views.label, views.view)
    model = _fit(task, views, np.flatnonzero(~held_out))
    if not held_out.any():
        return FittedBaseline(model, np.zeros((0, len(task.source.classes)), np.float32), views.label[held_out])
    inputs = views.xyz[held_out, :POINTS], views.rgb[held_out, :POINTS], views.box[held_out]
    return FittedBaseline(model, model.predict(*inputs), views.label[held_out])


def _fit(task: FitTask, views: _Views, rows: NDArray[np.intp]) -> ColoredPointNet:
    """Fit a PointNet on the views of these rows."""
    epochs, batch_size = task.options.epochs, min(BATCH_SIZE, len(rows))
    steps = Steps(epochs, len(rows) // batch_size, batch_size)
    split: Any = nnx.split(PointNet(len(task.source.classes), rngs=nnx.Rngs(task.options.seed)))
    graph, params = split
    leaves, structure = jax.tree.flatten((params, optax.adam(0.0).init(params)))

    def epoch(number: int) -> Iterator[tuple[NDArray[np.float32], NDArray[np.int32]]]:
        rng = np.random.default_rng((task.options.seed, number - 1))
        order = rng.permutation(rows)[: steps.of_epoch * batch_size]
        for batch in order.reshape(-1, batch_size):
            yield views.draw(batch, rng), views.label[batch]

    def step(leaves: list[Any], number: int, batch: tuple[Any, Any]) -> tuple[list[Any], Any]:
        rate = RATES[1] + (RATES[0] - RATES[1]) * (1 + np.cos(np.pi * number / (epochs * steps.of_epoch))) / 2
        *state, loss, accuracy = _step(graph, *jax.tree.unflatten(structure, leaves), *batch, np.float32(rate))
        return jax.tree.leaves(state), (loss, accuracy)

    with Checkpoints(task.scratch / "fit") as checkpoints:
        leaves = run_epochs("pointnet", leaves, steps, epoch, step, checkpoints, progress=task.report("pointnet"))
    return ColoredPointNet(nnx.merge(graph, jax.tree.unflatten(structure, leaves)[0]))
