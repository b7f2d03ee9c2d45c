"""A random forest on plain measures: which colours a cloud has, and how large its box and its slices are."""

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
from thor2_jax.types import PointClouds, Strips
from training.baselines.baseline import Fitted, Seen, Task
from training.fitting.samples import MIRRORS
from training.views.normalized_views import padded_batches

__all__ = ["Forest", "forest_features", "train_forest"]

TREES = 200
SMALLEST_LEAF = 2
CHUNK = 64


@partial(jax.jit, static_argnums=2)
def _measures(normal: PointClouds, found: Strips, config: DescriptorConfig) -> jax.Array:
    histogram = found.color.sum(axis=(1, 2))
    histogram = histogram / jnp.maximum(histogram.sum(axis=1, keepdims=True), 1)
    box = jnp.where(normal.mask[..., None], normal.points, 0).max(axis=1)
    number = jnp.arange(config.n_strips)
    first = jnp.where(found.occupied, number, config.n_strips).min(axis=2)
    last = jnp.where(found.occupied, number, -1).max(axis=2)
    low = jnp.where(found.occupied, found.low, jnp.inf).min(axis=2)
    high = jnp.where(found.occupied, found.high, -jnp.inf).max(axis=2)
    filled = last >= 0
    along_x = jnp.where(filled, (last - first + 1) * config.sigma_2, 0)
    along_y = jnp.where(filled, high - low, 0)
    return jnp.concatenate([histogram, box, along_x, along_y], axis=1)


def forest_features(normal: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> NDArray[np.float32]:
    """[B, R + 3 + 2 S] measures of normalized clouds, all lengths in scaled units.

    The share of each of the R colour regions in the points that the strips hold; the three sides of the box; of each of
    the S slices the extent along x, in whole strips, and along y.
    """
    return np.asarray(_measures(normal, strips(turn(normal, config), network, config), config))


class Forest:
    """Trees as arrays: any node's children, what it asks, and its shares of the classes.

    Attributes:
        arrays of all trees' nodes, one tree after the other: `left`, `right` [n] int32 (-1 in leaves), `feature` [n]
        int16, `threshold` [n] float64, `shares` [n, C] float32; and `root` [T] int32, each tree's first node.
    """

    def __init__(self, nodes: Mapping[str, NDArray[Any]], network: ColorNetwork, config: DescriptorConfig) -> None:
        """The trees, and what is needed for the measures that they ask."""
        missing = {"left", "right", "feature", "threshold", "shares", "root"} - set(nodes)
        if missing:
            raise ValueError(f"{', '.join(sorted(missing))} is missing")
        self._nodes, self._network, self._config = dict(nodes), network, config

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The trees."""
        return self._nodes

    def probabilities(self, seen: Seen) -> NDArray[np.float32]:
        """[B, C], mean over the trees."""
        return self.of_features(forest_features(seen.normal, self._network, self._config))

    def of_features(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """[B, C] of `forest_features`."""
        nodes = self._nodes
        rows = np.arange(len(features))[:, None]
        at = np.tile(nodes["root"], (len(features), 1))  # [B, T]
        while (inner := nodes["left"][at] >= 0).any():
            below = features[rows, nodes["feature"][at]] <= nodes["threshold"][at]
            at = np.where(inner, np.where(below, nodes["left"][at], nodes["right"][at]), at)
        return np.stack([nodes["shares"][leaves].mean(axis=0) for leaves in at]).astype(np.float32)


def _nodes_of(forest: RandomForestClassifier) -> dict[str, NDArray[Any]]:
    trees = [estimator.tree_ for estimator in forest.estimators_]
    root = np.concatenate([[0], np.cumsum([tree.node_count for tree in trees])[:-1]]).astype(np.int32)

    def children(name: str) -> NDArray[np.int32]:
        parts = [getattr(tree, name) for tree in trees]
        moved = [np.where(part < 0, -1, part + first) for part, first in zip(parts, root, strict=True)]
        return np.concatenate(moved).astype(np.int32)

    counts = np.concatenate([tree.value[:, 0] for tree in trees])
    return {
        "left": children("children_left"),
        "right": children("children_right"),
        "feature": np.concatenate([tree.feature for tree in trees]).astype(np.int16),
        "threshold": np.concatenate([tree.threshold for tree in trees]),
        "shares": (counts / counts.sum(axis=1, keepdims=True)).astype(np.float32),
        "root": root,
    }


def train_forest(task: Task) -> Fitted:
    """Measure every view and its mirror images, grow the trees."""
    features, label, view = [], [], []
    done, total = 0, sum(shard.views for shard in task.source.shards)
    for index, shard in enumerate(task.source.shards):
        views = task.source.read(index)
        for count, normal in padded_batches(views.clouds(), CHUNK):
            features += [forest_features(mirror(normal, axes), task.network, task.config)[:count] for axes in MIRRORS]
            done += count
            task.progress("measure for forest", done, total, "views")
        # In the order of the features: batch by batch, mirror by mirror.
        for first in range(0, len(views), CHUNK):
            part = views.view[first : first + CHUNK]
            view += [part] * len(MIRRORS)
            label += [np.full(len(part), shard.label)] * len(MIRRORS)
    x, y, number = np.concatenate(features), np.concatenate(label), np.concatenate(view)
    held_out = task.held_out(y, number)
    forest = RandomForestClassifier(
        TREES, min_samples_leaf=SMALLEST_LEAF, max_features="sqrt", random_state=task.options.seed, n_jobs=-1
    )
    forest.fit(x[~held_out], y[~held_out])
    task.progress("grow forest", 1, 1, f"{TREES} trees")
    model = Forest(_nodes_of(forest), task.network, task.config)
    said = model.of_features(x[held_out]) if held_out.any() else np.zeros((0, len(task.source.classes)), np.float32)
    return Fitted(model, said, y[held_out])
