"""A PointNet (Qi et al., CVPR 2017) that reads colours too, on view-normalized clouds."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from training.baselines.baseline import Fitted, Seen, Task
from training.baselines.files import load_arrays, model_arrays

__all__ = ["POINTS", "ColoredPointNet", "PointNet", "train_pointnet"]

POINTS = 384
"""Drawn from each cloud."""

KEPT = 2 * POINTS
"""Points of a view that are kept for training: every epoch sees other ones."""

SHARED = (64, 128, 384)
HEAD = 256
RATES = 2e-3, 2e-5
"""Adam's step size at the beginning and at the end, on half a cosine between."""

BATCH = 64
CHUNK = 256
SEED_OF_DRAW = 0


class PointNet(nnx.Module):
    """6-64-128-384 for each point, the maximum over the points, 256, logits; ReLU between."""

    def __init__(self, n_classes: int, *, rngs: nnx.Rngs) -> None:
        """Fresh weights."""
        sizes = (6, *SHARED)
        self.shared = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.hidden = nnx.Linear(SHARED[-1], HEAD, rngs=rngs)
        self.head = nnx.Linear(HEAD, n_classes, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Logits [B, C] of points [B, P, 6], as `_inputs` gives them."""
        for layer in self.shared:
            x = nnx.relu(layer(x))
        return self.head(nnx.relu(self.hidden(x.max(axis=1))))


def _inputs(xyz: Any, rgb: Any, box: Any) -> jax.Array:
    """Points about the middle of the box, scaled units, and colours about grey: [B, P, 6]."""
    return jnp.concatenate([xyz - box[:, None] / 2, rgb.astype(jnp.float32) / 255 - 0.5], axis=2)


def _drawn(count: int, points: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Numbers of so many points at random, again and again all if there are fewer."""
    return np.resize(rng.permutation(count), points)


class _Views(NamedTuple):
    """Views to train on: [V, KEPT, 3] points and colours in random order, [V, 3] boxes, [V] classes and numbers."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    box: NDArray[np.float32]
    label: NDArray[np.int32]
    view: NDArray[np.int32]


def _views(task: Task) -> _Views:
    total = sum(shard.views for shard in task.source.shards)
    views = _Views(
        np.zeros((total, KEPT, 3), np.float16),
        np.zeros((total, KEPT, 3), np.uint8),
        np.zeros((total, 3), np.float32),
        np.zeros(total, np.int32),
        np.zeros(total, np.int32),
    )
    row = 0
    rng = np.random.default_rng(task.options.seed)
    for index, shard in enumerate(task.source.shards):
        found = task.source.read(index)
        for (xyz, rgb), number in zip(found.clouds(), found.view, strict=True):
            drawn = _drawn(len(xyz), KEPT, rng)
            views.xyz[row], views.rgb[row], views.box[row] = xyz[drawn], rgb[drawn], xyz.max(axis=0)
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


@partial(jax.jit, static_argnums=0)
def _probabilities(graph: Any, params: Any, xyz: Any, rgb: Any, box: Any) -> jax.Array:
    return jax.nn.softmax(nnx.merge(graph, params)(_inputs(xyz, rgb, box)))


class ColoredPointNet:
    """A trained network, and the draw of its points."""

    def __init__(self, model: PointNet) -> None:
        """Ready to answer."""
        self._model = model
        self._graph, self._params = nnx.split(model)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Weights by their paths."""
        return model_arrays(self._model)

    @classmethod
    def with_arrays(cls, arrays: Mapping[str, NDArray[Any]], n_classes: int) -> "ColoredPointNet":
        """The inverse of `arrays`; raises ValueError if some are missing."""
        return cls(load_arrays(PointNet(n_classes, rngs=nnx.Rngs(0)), arrays))

    def probabilities(self, seen: Seen) -> NDArray[np.float32]:
        """[B, C]; the points drawn depend on their number alone."""
        points, colors = np.asarray(seen.normal.points), np.asarray(seen.normal.colors)
        counts = np.asarray(seen.normal.mask).sum(axis=1)
        xyz = np.zeros((len(points), POINTS, 3), np.float32)
        rgb, box = np.zeros_like(xyz), np.zeros((len(points), 3), np.float32)
        for row, count in enumerate(counts.tolist()):
            if count:  # padding stands behind the points
                drawn = _drawn(count, POINTS, np.random.default_rng(SEED_OF_DRAW))
                xyz[row], rgb[row], box[row] = (
                    points[row, drawn],
                    colors[row, drawn] * 255,
                    points[row, :count].max(axis=0),
                )
        return np.asarray(_probabilities(self._graph, self._params, xyz, rgb, box))

    def of_views(self, xyz: NDArray[Any], rgb: NDArray[Any], box: NDArray[Any]) -> NDArray[np.float32]:
        """[V, C] of views' points [V, POINTS, 3], colours and boxes."""
        parts = []
        for first in range(0, len(xyz), CHUNK):
            rows = np.resize(np.arange(first, min(first + CHUNK, len(xyz))), CHUNK)
            found = _probabilities(self._graph, self._params, xyz[rows].astype(np.float32), rgb[rows], box[rows])
            parts.append(np.asarray(found)[: len(xyz) - first])
        return np.concatenate(parts)


def train_pointnet(task: Task) -> Fitted:
    """Adam on cross-entropy; each epoch sees every view once, mirrored at random in x and y, other points each time.

    Raises:
        InputError: the loss is not finite, or all views are held out.
    """
    views = _views(task)
    held_out = task.held_out(views.label, views.view)
    rows, epochs = np.flatnonzero(~held_out), task.options.epochs
    batch = min(BATCH, len(rows))
    steps = len(rows) // batch
    split: Any = nnx.split(PointNet(len(task.source.classes), rngs=nnx.Rngs(task.options.seed)))
    graph, params = split
    optimizer = optax.adam(0.0).init(params)
    for epoch in range(epochs):
        rng = np.random.default_rng((task.options.seed, epoch))
        order = rng.permutation(rows)
        right = 0.0
        for step in range(steps):
            mine = order[step * batch : (step + 1) * batch]
            window = int(rng.integers(KEPT - POINTS + 1))
            some = slice(window, window + POINTS)
            x = np.array(_inputs(views.xyz[mine, some].astype(np.float32), views.rgb[mine, some], views.box[mine]))
            x[..., :2] *= rng.choice(np.array([-1, 1], np.float32), (batch, 1, 2))
            part = (epoch * steps + step) / (epochs * steps)
            rate = np.float32(RATES[1] + (RATES[0] - RATES[1]) * (1 + np.cos(np.pi * part)) / 2)
            params, optimizer, loss, accuracy = _step(graph, params, optimizer, x, views.label[mine], rate)
            right += float(accuracy)
            if not np.isfinite(loss):
                raise InputError(f"the training loss of pointnet is {loss} in epoch {epoch + 1}")
            note = f"epoch {epoch + 1}, accuracy {right / (step + 1):.3f}"
            task.progress("fit pointnet", epoch * steps + step + 1, epochs * steps, note)
    model = ColoredPointNet(nnx.merge(graph, params))
    asked = views.xyz[held_out, :POINTS], views.rgb[held_out, :POINTS], views.box[held_out]
    said = model.of_views(*asked) if held_out.any() else np.zeros((0, len(task.source.classes)), np.float32)
    return Fitted(model, said, views.label[held_out])
