"""Fitting the random forest baseline with scikit-learn."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier

from thor2_jax.descriptor.view_normalization import mirror
from training.baselines.forest import Forest, forest_features
from training.baselines.task import FitTask, FittedBaseline
from training.fitting.samples import MIRRORS, VIEWS_PER_BATCH
from training.views.normalized_views import padded_batches

__all__ = ["fit_forest", "tree_arrays"]

TREES = 200
MIN_LEAF_SAMPLES = 2


def tree_arrays(forest: RandomForestClassifier) -> dict[str, NDArray[Any]]:
    """Return the trees of a fitted scikit-learn forest as the arrays of `Forest`."""
    trees = [estimator.tree_ for estimator in forest.estimators_]
    root = np.concatenate([[0], np.cumsum([tree.node_count for tree in trees])[:-1]]).astype(np.int32)

    def children(name: str) -> NDArray[np.int32]:
        indices = [getattr(tree, name) for tree in trees]
        return np.concatenate([np.where(i < 0, -1, i + first) for i, first in zip(indices, root, strict=True)])

    counts = np.concatenate([tree.value[:, 0] for tree in trees])
    return {
        "left": children("children_left").astype(np.int32),
        "right": children("children_right").astype(np.int32),
        "feature": np.concatenate([tree.feature for tree in trees]).astype(np.int16),
        "threshold": np.concatenate([tree.threshold for tree in trees]),
        "shares": (counts / counts.sum(axis=1, keepdims=True)).astype(np.float32),
        "root": root,
    }


def fit_forest(task: FitTask) -> FittedBaseline:
    """Fit a random forest on the features of every view and its mirror images."""
    x, y, view = _features_of_views(task)
    held_out = task.held_out(y, view)
    forest = RandomForestClassifier(
        TREES, min_samples_leaf=MIN_LEAF_SAMPLES, max_features="sqrt", random_state=task.options.seed, n_jobs=-1
    )
    forest.fit(x[~held_out], y[~held_out])
    task.progress("grow forest", 1, 1, f"{TREES} trees")
    model = Forest(tree_arrays(forest), task.network, task.config)
    if not held_out.any():
        return FittedBaseline(model, np.zeros((0, len(task.source.classes)), np.float32), y[held_out])
    return FittedBaseline(model, model.predict(x[held_out]), y[held_out])


def _features_of_views(task: FitTask) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Return features, class index and view number of every view in every mirror."""
    features, label, view = [], [], []
    done, total = 0, sum(shard.views for shard in task.source.shards)
    for index, shard in enumerate(task.source.shards):
        views = task.source.read(index)
        first = 0
        for count, normal in padded_batches(views.clouds(), VIEWS_PER_BATCH):
            for axes in MIRRORS:
                features.append(forest_features(mirror(normal, axes), task.network, task.config)[:count])
                label.append(np.full(count, shard.label))
                view.append(views.view[first : first + count])
            first += count
            done += count
            task.progress("measure for forest", done, total, "views")
    return np.concatenate(features), np.concatenate(label), np.concatenate(view)
