"""Baselines on point clouds: a random forest on simple measurements, and a PointNet (Qi et al., CVPR 2017).

The forest measures the colour histogram, the box size and the slice sizes of a cloud. The PointNet reads the points and
colours of view-normalized clouds.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier

from colornet import ColorNetwork
from thor2_jax import DescriptorConfig, PointClouds, Strips, mirror, strips, turn
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import Linear, model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs, FitTask, Predictor, StoredBaseline, compiled_network, in_batches
from training.fitting.samples import MIRRORS
from training.views.normalized_views import padded_batches

__all__ = ["fit_forest", "fit_pointnet", "load_forest", "load_pointnet"]


@partial(jax.jit, static_argnums=2)
def _measure(normal: PointClouds, cut: Strips, config: DescriptorConfig) -> jax.Array:
    histogram = cut.color.sum(axis=(1, 2))
    histogram = histogram / jnp.maximum(histogram.sum(axis=1, keepdims=True), 1)
    box = jnp.where(normal.mask[..., None], normal.points, 0).max(axis=1)
    number = jnp.arange(config.n_strips)
    first = jnp.where(cut.occupied, number, config.n_strips).min(axis=2)
    last = jnp.where(cut.occupied, number, -1).max(axis=2)
    low = jnp.where(cut.occupied, cut.low, jnp.inf).min(axis=2)
    high = jnp.where(cut.occupied, cut.high, -jnp.inf).max(axis=2)
    filled = last >= 0
    along_x = jnp.where(filled, (last - first + 1) * config.sigma_2, 0)
    along_y = jnp.where(filled, high - low, 0)
    return jnp.concatenate([histogram, box, along_x, along_y], axis=1)


def forest_features(normal: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> NDArray[np.float32]:
    """Return [B, R + 3 + 2 S] features of view-normalized clouds, lengths in scaled units.

    The features are, in this order: the fraction of each of the R colour regions among the points inside the strips;
    the three side lengths of the bounding box; the extent of each of the S slices along x, in whole strips; and the
    extent of each slice along y.
    """
    return np.asarray(_measure(normal, strips(turn(normal, config), network, config), config))


NODES = ("left", "right", "feature", "threshold", "shares", "root")
"""Arrays of all trees' nodes, concatenated: `left` and `right` [n] int32, child indices (-1 in leaves); `feature` [n]
int16; `threshold` [n] float64; `shares` [n, C] float32, class probabilities; and `root` [T] int32, the first node of
each tree."""


def load_forest(arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Return a forest built from the arrays `NODES`; raise KeyError if one is missing."""
    nodes = {name: arrays[name] for name in NODES}
    return lambda inputs: predict_forest(nodes, forest_features(inputs.normal, run.network, run.config))


def predict_forest(nodes: Mapping[str, NDArray[Any]], features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return class probabilities [B, C] for `forest_features` as the mean over the trees."""
    rows = np.arange(len(features))[:, None]
    at = np.tile(nodes["root"], (len(features), 1))  # [B, T]
    while (inner := nodes["left"][at] >= 0).any():
        below = features[rows, nodes["feature"][at]] <= nodes["threshold"][at]
        at = np.where(inner, np.where(below, nodes["left"][at], nodes["right"][at]), at)
    return np.stack([nodes["shares"][leaves].mean(axis=0) for leaves in at]).astype(np.float32)


TREES = 200


def tree_arrays(forest: RandomForestClassifier) -> dict[str, NDArray[Any]]:
    """Return the trees of a fitted scikit-learn forest as the arrays `NODES`."""
    trees = [estimator.tree_ for estimator in forest.estimators_]
    root = np.concatenate([[0], np.cumsum([tree.node_count for tree in trees])[:-1]]).astype(np.int32)

    def children(name: str) -> NDArray[np.int32]:
        indices = zip((getattr(tree, name) for tree in trees), root, strict=True)
        return np.concatenate([np.where(i < 0, -1, i + first) for i, first in indices]).astype(np.int32)

    return {
        "left": children("children_left"),
        "right": children("children_right"),
        "feature": np.concatenate([tree.feature for tree in trees]).astype(np.int16),
        "threshold": np.concatenate([tree.threshold for tree in trees]),
        "shares": np.concatenate([tree.value[:, 0] for tree in trees]).astype(np.float32),
        "root": root,
    }


def fit_forest(task: FitTask) -> StoredBaseline:
    """Fit a random forest on the features of every view and its mirror images."""
    x, y, view = _features_of_views(task)
    held_out = task.held_out(y, view)
    seed = task.options.seed
    forest = RandomForestClassifier(TREES, min_samples_leaf=2, max_features="sqrt", random_state=seed, n_jobs=-1)
    forest.fit(x[~held_out], y[~held_out])
    task.progress("grow forest", 1, 1, f"{TREES} trees")
    nodes = tree_arrays(forest)
    return StoredBaseline(nodes, task.temperature(y, held_out, lambda: predict_forest(nodes, x[held_out])))


def _features_of_views(task: FitTask) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Return features, class index and view number of every view in every mirror."""
    features, label, view, run = [], [], [], task.run
    for _, _, views in task.shards("measure for forest", "views"):
        first = 0
        for count, normal in padded_batches(views.clouds()):
            for axes in MIRRORS:
                features.append(forest_features(mirror(normal, axes), run.network, run.config)[:count])
                label.append(np.full(count, views.label))
                view.append(views.view[first : first + count])
            first += count
    return np.concatenate(features), np.concatenate(label), np.concatenate(view)


POINTS = 384
"""Points sampled from each cloud, repeated if it has fewer."""

SHARED = (64, 128, 384)
HEAD = 256
INFERENCE_BATCH = 256


class PointNet(nnx.Module):
    """PointNet: layers 6-64-128-384 on each point, maximum over points, layer of 256, logits; ReLU in between."""

    def __init__(self, n_classes: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        sizes = (6, *SHARED)
        self.shared = nnx.List([Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.hidden = Linear(SHARED[-1], HEAD, rngs=rngs)
        self.head = Linear(HEAD, n_classes, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return logits [B, C] for `point_features` [B, P, 6]."""
        for layer in self.shared:
            x = nnx.relu(layer(x))
        return self.head(nnx.relu(self.hidden(x.max(axis=1))))


def point_features(xyz: Any, rgb: Any, box: Any) -> tuple[jax.Array]:
    """Return the input [B, P, 6]: points relative to the centre of their box, scaled units, and colours minus 0.5.

    Args:
        xyz: [B, P, 3] points.
        rgb: [B, P, 3] colours from 0 to 255.
        box: [B, 3] side lengths of the bounding boxes.
    """
    return (jnp.concatenate([xyz - box[:, None] / 2, rgb.astype(jnp.float32) / 255 - 0.5], axis=2),)


def load_pointnet(arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Build a PointNet from its weights; the sampled points of a cloud depend only on its number of points.

    Raises:
        ValueError: an array is missing or has another shape.
    """
    model = model_from_arrays(lambda: PointNet(len(run.classes), rngs=nnx.Rngs(0)), arrays)
    predict = compiled_network(model, point_features)

    def probabilities(inputs: BaselineInputs) -> NDArray[np.float32]:
        clouds = inputs.normal.unpack()
        xyz = np.zeros((len(clouds), POINTS, 3), np.float32)
        rgb, box = np.zeros_like(xyz), np.zeros((len(clouds), 3), np.float32)
        for row, (points, colors) in enumerate(clouds):
            if len(points):
                sample = np.resize(np.random.default_rng(0).permutation(len(points)), POINTS)
                xyz[row], rgb[row], box[row] = points[sample], colors[sample] * 255, points.max(axis=0)
        return np.asarray(predict((xyz, rgb, box)))

    return probabilities


STORED_POINTS = 2 * POINTS
"""Number of points stored for each view, so that every epoch can use a different sample."""

RATES = 2e-3, 2e-5
"""First and last learning rate of the cosine schedule."""

BATCH_SIZE = 64


def _learning_rate(number: int, n_steps: int) -> float:
    return float(RATES[1] + (RATES[0] - RATES[1]) * (1 + np.cos(np.pi * number / n_steps)) / 2)


def fit_pointnet(task: FitTask) -> StoredBaseline:
    """Fit a PointNet; an interrupted fit resumes after its last epoch.

    Each epoch uses every view once, with a random sample of points and random mirroring.

    Raises:
        InputError: the loss is not finite.
    """
    total, sampling = task.n_clouds, np.random.default_rng(task.options.seed)
    # The points and colours of each view are stored in random order.
    xyz, rgb = (np.zeros((total, STORED_POINTS, 3), kind) for kind in (np.float16, np.uint8))
    box, (label, view) = np.zeros((total, 3), np.float32), np.zeros((2, total), np.int32)
    for _, rows, views in task.shards("read for pointnet", "views"):
        label[rows], view[rows] = views.label, views.view
        for row, (points, colors) in enumerate(views.clouds(), rows.start):
            sample = np.resize(sampling.permutation(len(points)), STORED_POINTS)
            xyz[row], rgb[row], box[row] = points[sample], colors[sample], points.max(axis=0)

    def draw(rows: NDArray[np.intp], rng: np.random.Generator) -> tuple[NDArray[np.float32]]:
        """Return network inputs for some views: a random sample of their points, randomly mirrored in x and y."""
        first = int(rng.integers(STORED_POINTS - POINTS + 1))
        window = slice(first, first + POINTS)
        (features,) = point_features(xyz[rows, window].astype(np.float32), rgb[rows, window], box[rows])
        x = np.array(features)
        x[..., :2] *= rng.choice(np.array([-1, 1], np.float32), (len(rows), 1, 2))
        return (x,)

    held_out = task.held_out(label, view)
    network = PointNet(len(task.source.classes), rngs=nnx.Rngs(task.options.seed))
    model = task.fit_network(network, label, held_out, draw, optax.adam, _learning_rate, BATCH_SIZE)
    stored = xyz[held_out, :POINTS].astype(np.float32), rgb[held_out, :POINTS], box[held_out]
    predict = compiled_network(model, point_features)
    temperature = task.temperature(label, held_out, lambda: in_batches(predict, INFERENCE_BATCH, *stored))
    return StoredBaseline(model_arrays(model), temperature)
