"""A PointNet (Qi et al., CVPR 2017) on the points and colours of view-normalized clouds."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.model.classifier import model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs, FitTask, FittedBaseline, NetworkFit, fit_network, in_batches

__all__ = ["ColoredPointNet", "POINTS", "PointNet", "fit_pointnet"]

POINTS = 384
"""Points sampled from each cloud."""

SHARED = (64, 128, 384)
HEAD = 256
INFERENCE_BATCH = 256
SAMPLING_SEED = 0


class PointNet(nnx.Module):
    """Layers 6-64-128-384 on each point, maximum over the points, a layer of 256, logits; ReLU in between."""

    def __init__(self, n_classes: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        sizes = (6, *SHARED)
        self.shared = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.hidden = nnx.Linear(SHARED[-1], HEAD, rngs=rngs)
        self.head = nnx.Linear(HEAD, n_classes, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return logits [B, C] for `point_features` [B, P, 6]."""
        for layer in self.shared:
            x = nnx.relu(layer(x))
        return self.head(nnx.relu(self.hidden(x.max(axis=1))))


def point_features(xyz: Any, rgb: Any, box: Any) -> jax.Array:
    """Return [B, P, 6] inputs: points relative to the centre of their box, scaled units, and colours minus 0.5.

    Args:
        xyz: [B, P, 3] points.
        rgb: [B, P, 3] colours from 0 to 255.
        box: [B, 3] side lengths of the bounding boxes.
    """
    return jnp.concatenate([xyz - box[:, None] / 2, rgb.astype(jnp.float32) / 255 - 0.5], axis=2)


def random_indices(count: int, points: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of `points` random points of `count`, repeated if there are too few points."""
    return np.resize(rng.permutation(count), points)


@partial(jax.jit, static_argnums=0)
def _probabilities(graph: Any, params: Any, xyz: Any, rgb: Any, box: Any) -> jax.Array:
    return jax.nn.softmax(nnx.merge(graph, params)(point_features(xyz, rgb, box)))


class ColoredPointNet:
    """A trained PointNet with its point sampling."""

    def __init__(self, model: PointNet) -> None:
        """Store the network."""
        self._model, self._probabilities = model, partial(_probabilities, *nnx.split(model))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the weights by their paths."""
        return model_arrays(self._model)

    @classmethod
    def with_arrays(cls, arrays: Mapping[str, NDArray[Any]], n_classes: int) -> "ColoredPointNet":
        """Build the network from `arrays`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        return cls(model_from_arrays(lambda: PointNet(n_classes, rngs=nnx.Rngs(0)), arrays))

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities [B, C]; which points are sampled depends only on the number of points."""
        points, colors = np.asarray(inputs.normal.points), np.asarray(inputs.normal.colors)
        counts = np.asarray(inputs.normal.mask).sum(axis=1)
        xyz = np.zeros((len(points), POINTS, 3), np.float32)
        rgb, box = np.zeros_like(xyz), np.zeros((len(points), 3), np.float32)
        for row, count in enumerate(counts.tolist()):
            if count:  # padding follows the points
                sample = random_indices(count, POINTS, np.random.default_rng(SAMPLING_SEED))
                xyz[row], rgb[row] = points[row, sample], colors[row, sample] * 255
                box[row] = points[row, :count].max(axis=0)
        return np.asarray(self._probabilities(xyz, rgb, box))

    def predict(self, xyz: NDArray[Any], rgb: NDArray[Any], box: NDArray[Any]) -> NDArray[np.float32]:
        """Return class probabilities [V, C] for sampled points [V, POINTS, 3], their colours and boxes [V, 3]."""
        return in_batches(self._probabilities, INFERENCE_BATCH, xyz.astype(np.float32), rgb, box)


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

    def draw(self, rows: NDArray[np.intp], rng: np.random.Generator) -> tuple[NDArray[np.float32]]:
        """Return network inputs for some views: a random sample of their points, mirrored at random in x and y."""
        first = int(rng.integers(STORED_POINTS - POINTS + 1))
        window = slice(first, first + POINTS)
        x = np.array(point_features(self.xyz[rows, window].astype(np.float32), self.rgb[rows, window], self.box[rows]))
        x[..., :2] *= rng.choice(np.array([-1, 1], np.float32), (len(rows), 1, 2))
        return (x,)


def _read_views(task: FitTask) -> _Views:
    total = task.n_clouds
    xyz, rgb = (np.zeros((total, STORED_POINTS, 3), kind) for kind in (np.float16, np.uint8))
    of_class, view = np.zeros((2, total), np.int32)
    views = _Views(xyz, rgb, np.zeros((total, 3), np.float32), of_class, view)
    rng = np.random.default_rng(task.options.seed)
    for index, rows, label in task.shards("read for pointnet", "views"):
        normalized = task.source.read(index)
        views.label[rows], views.view[rows] = label, normalized.view
        for row, (xyz, rgb) in enumerate(normalized.clouds(), rows.start):
            sample = random_indices(len(xyz), STORED_POINTS, rng)
            views.xyz[row], views.rgb[row], views.box[row] = xyz[sample], rgb[sample], xyz.max(axis=0)
    return views


def _learning_rate(number: int, n_steps: int) -> float:
    return float(RATES[1] + (RATES[0] - RATES[1]) * (1 + np.cos(np.pi * number / n_steps)) / 2)


def _inputs(x: jax.Array) -> tuple[jax.Array]:
    return (x,)


def fit_pointnet(task: FitTask) -> FittedBaseline:
    """Fit a PointNet; an interrupted fit resumes after its last epoch.

    Each epoch uses every view once, with a random sample of points and random mirroring.

    Raises:
        InputError: the loss is not finite.
    """
    views = _read_views(task)
    held_out = task.held_out(views.label, views.view)
    rows = np.flatnonzero(~held_out)
    fit = NetworkFit("fit", views.draw, _inputs, BATCH_SIZE, optax.adam, _learning_rate)
    network = PointNet(len(task.source.classes), rngs=nnx.Rngs(task.options.seed))
    model = ColoredPointNet(fit_network(task, fit, network, views.label, rows, len(rows)))
    inputs = views.xyz[held_out, :POINTS], views.rgb[held_out, :POINTS], views.box[held_out]
    return FittedBaseline(model, task.temperature(views.label, held_out, lambda: model.predict(*inputs)))
