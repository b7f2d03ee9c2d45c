"""A random forest on simple measurements: colour histogram, box size and slice sizes of a cloud."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.view_normalization import mirror, turn
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.types import PointClouds, Strips
from training.baselines.baseline import FitTask, Predictor, StoredBaseline
from training.fitting.samples import MIRRORS
from training.views.normalized_views import padded_batches

__all__ = ["fit_forest", "forest_features", "load_forest", "predict", "tree_arrays"]


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
    return lambda inputs: predict(nodes, forest_features(inputs.normal, run.network, run.config))


def predict(nodes: Mapping[str, NDArray[Any]], features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return class probabilities [B, C] for `forest_features` as the mean over the trees."""
    rows = np.arange(len(features))[:, None]
    at = np.tile(nodes["root"], (len(features), 1))  # [B, T]
    while (inner := nodes["left"][at] >= 0).any():
        below = features[rows, nodes["feature"][at]] <= nodes["threshold"][at]
        at = np.where(inner, np.where(below, nodes["left"][at], nodes["right"][at]), at)
    return np.stack([nodes["shares"][leaves].mean(axis=0) for leaves in at]).astype(np.float32)


TREES = 200
MIN_LEAF_SAMPLES = 2


def tree_arrays(forest: RandomForestClassifier) -> dict[str, NDArray[Any]]:
    """Return the trees of a fitted scikit-learn forest as the arrays `NODES`."""
    trees = [estimator.tree_ for estimator in forest.estimators_]
    root = np.concatenate([[0], np.cumsum([tree.node_count for tree in trees])[:-1]]).astype(np.int32)

    def children(name: str) -> NDArray[np.int32]:
        indices = zip((getattr(tree, name) for tree in trees), root, strict=True)
        return np.concatenate([np.where(i < 0, -1, i + first) for i, first in indices]).astype(np.int32)

    counts = np.concatenate([tree.value[:, 0] for tree in trees])
    return {
        "left": children("children_left"),
        "right": children("children_right"),
        "feature": np.concatenate([tree.feature for tree in trees]).astype(np.int16),
        "threshold": np.concatenate([tree.threshold for tree in trees]),
        "shares": (counts / counts.sum(axis=1, keepdims=True)).astype(np.float32),
        "root": root,
    }


def fit_forest(task: FitTask) -> StoredBaseline:
    """Fit a random forest on the features of every view and its mirror images."""
    x, y, view = _features_of_views(task)
    held_out = task.held_out(y, view)
    forest = RandomForestClassifier(
        TREES, min_samples_leaf=MIN_LEAF_SAMPLES, max_features="sqrt", random_state=task.options.seed, n_jobs=-1
    )
    forest.fit(x[~held_out], y[~held_out])
    task.progress("grow forest", 1, 1, f"{TREES} trees")
    nodes = tree_arrays(forest)
    return StoredBaseline(nodes, task.temperature(y, held_out, lambda: predict(nodes, x[held_out])))


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
