"""Baselines on point clouds: THOR, a random forest on simple measurements, and a PointNet (Qi et al., CVPR 2017).

THOR is the predecessor (Samani and Banerjee, "Persistent Homology Meets Object Unity", T-RO 2024; arXiv 2305.03815), a
library of MLPs on TOPS: one for each view type (front, side, top) and each number of slices k, which reads the first k
slices. The classifiers of a type are trained on the views of that type's cameras. Two rules select the classifiers for
a cloud:

- number of slices: the number of slices of the cloud if its far end is occluded, otherwise all slices;
- view types: one or two, from the areas of the three visible faces of the bounding box. With two classifiers, the more
  confident one determines the class.

Two parts of the published code are left out, see docs/decisions.md.

The forest measures the colour histogram, the box size and the slice sizes of a cloud. The PointNet reads the points and
colours of view-normalized clouds.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray
from sklearn.ensemble import RandomForestClassifier

from colornet import ColorNetwork
from thor2_jax import DescriptorConfig, InputError, PointClouds, Strips, mirror, strips
from thor2_jax.descriptor.view_normalization import OCCLUSION_BIN, turn
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import MLP, Linear, model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs, FitTask, Predictor, StoredBaseline, compiled_network, in_batches
from training.fitting.fit import FitContext, fit, sample_probabilities
from training.fitting.loop import Checkpoints, EpochMetrics
from training.fitting.samples import MIRRORS, sample_views
from training.rendering.camera import view_angles
from training.views.normalized_views import padded_batches

__all__ = ["fit_forest", "fit_pointnet", "fit_thor", "load_forest", "load_pointnet", "load_thor", "types_of_views"]

ViewType = Literal["front", "side", "top"]
VIEW_TYPES: tuple[ViewType, ...] = ("front", "side", "top")

AREA_TOLERANCE = 0.2
"""Two areas count as equal if they differ by at most this fraction of the larger one."""


def _equal(a: float, b: float) -> bool:
    return abs(a - b) <= AREA_TOLERANCE * max(a, b)


def view_types(facing: float, second: float, third: float) -> tuple[ViewType, ...]:
    """Return the view types of a cloud from the areas of its box's visible faces, starting with the facing one.

    - All areas equal: front.
    - The other two areas equal: top if the facing area is smaller than them, front if it is larger.
    - The facing area equal to one other, or all areas different: front and side if the facing area is among the larger
      ones, side and top if it is among the smaller ones.
    """
    if _equal(facing, second):
        if _equal(second, third) and _equal(third, facing):
            return ("front",)
        return ("front", "side") if third < min(facing, second) else ("side", "top")
    if _equal(second, third):
        return ("top",) if facing < min(second, third) else ("front",)
    if _equal(facing, third):
        return ("front", "side") if second < min(facing, third) else ("side", "top")
    return ("side", "top") if facing < min(second, third) else ("front", "side")


def _face_areas(normal: PointClouds) -> NDArray[np.float64]:
    """Return the areas [B, 3] of the visible faces, starting with the face towards the camera."""
    points = np.where(np.asarray(normal.mask)[..., None], np.asarray(normal.points), 0).astype(np.float64)
    box = points.max(axis=1)
    sight = np.abs(np.asarray(normal.camera, np.float64) - box / 2)
    # Face k is spanned by the other two axes. The two faces not towards the camera stay in the order of the axes.
    faces = np.stack([box[:, 1] * box[:, 2], box[:, 0] * box[:, 2], box[:, 0] * box[:, 1]], axis=1)
    facing = np.arange(3) == sight.argmax(axis=1)[:, None]
    return np.take_along_axis(faces, np.argsort(~facing, axis=1, kind="stable"), axis=1)


def _far_end_occluded(normal: PointClouds) -> NDArray[np.bool_]:
    """Return whether the last two x-bins of each cloud hold more occlusion boundary points than the first two, [B]."""
    x = np.asarray(normal.points)[..., 0]
    edge = np.asarray(normal.boundary & normal.mask)
    number = np.floor(x / OCCLUSION_BIN)
    last = np.where(np.asarray(normal.mask), number, -1).max(axis=1, keepdims=True)
    return np.asarray((edge & (number >= last - 1)).sum(axis=1) > (edge & (number <= 1)).sum(axis=1))


def _slice_counts(normal: PointClouds, config: DescriptorConfig) -> NDArray[np.intp]:
    """Return the number of slices of each cloud, at least 1, [B]."""
    aligned = turn(normal, config)
    top = np.where(np.asarray(aligned.mask), np.asarray(aligned.points)[..., 2], 0).max(axis=1)
    return np.clip(np.floor(top / config.sigma_1).astype(np.intp) + 1, 1, config.n_slices)


def _create_mlp(n_inputs: int, n_classes: int) -> MLP:
    return MLP(n_inputs, n_classes, rngs=nnx.Rngs(0))


def load_thor(arrays: Mapping[str, NDArray[Any]], run: TrainedRun) -> Predictor:
    """Build the library from its weights, named `<type>-<slices>/<path>`.

    The class probabilities of a cloud are from the most confident classifier that the rules select for it.

    Raises:
        ValueError: an array is missing or has another shape.
    """
    config, size, predict = run.config, run.config.image_size**2, {}
    for name, k in itertools.product(VIEW_TYPES, range(1, config.n_slices + 1)):
        create = partial(_create_mlp, k * size, len(run.classes))
        predict[name, k] = compiled_network(model_from_arrays(create, arrays, f"{name}-{k}/"))

    def probabilities(inputs: BaselineInputs) -> NDArray[np.float32]:
        normal = inputs.normal
        slices = np.where(_far_end_occluded(normal), _slice_counts(normal, config), config.n_slices).tolist()
        types = [view_types(*areas) for areas in _face_areas(normal).tolist()]
        selected = [[(name, k) for name in names] for names, k in zip(types, slices, strict=True)]
        values = {
            (name, k): np.asarray(predict[name, k]((inputs.tops[:, : k * size],)))
            for name, k in set(itertools.chain(*selected))
        }
        return np.stack([max((values[key][row] for key in keys), key=np.max) for row, keys in enumerate(selected)])

    return probabilities


def camera_types(azimuth: float, polar: float) -> tuple[ViewType, ...]:
    """Return the view types of a training camera at these angles, degrees; two where the ranges overlap."""
    lying = 40 <= polar <= 140
    from_front = min(abs((azimuth - centre + 180) % 360 - 180) for centre in (0, 180))
    from_side = min(abs((azimuth - centre + 180) % 360 - 180) for centre in (90, 270))
    fits = {"front": lying and from_front <= 50, "side": lying and from_side <= 50, "top": polar <= 50 or polar >= 130}
    return tuple(name for name in VIEW_TYPES if fits[name])


def types_of_views(job: Mapping[str, Any]) -> list[tuple[ViewType, ...]]:
    """Return the view types of each view of an object, in the order of `view_angles`.

    Args:
        job: table with the steps of the views, such as `RenderJob.record`.

    Raises:
        InputError: a type has no view, or a step is invalid.
    """
    steps = job["azimuth_step"], job["polar_step"]
    types = [camera_types(*angles) for angles in np.rad2deg(view_angles(*steps)).round(6).tolist()]
    if missing := set(VIEW_TYPES).difference(*types):
        raise InputError(
            f"baselines: thor needs views from the {' and '.join(sorted(missing))}, and azimuth_step {steps[0]:g} with "
            f"polar_step {steps[1]:g} gives none; choose smaller steps, or leave out thor"
        )
    return types


def fit_thor(task: FitTask) -> StoredBaseline:
    """Fit the library, each classifier in the same way as the run's own; an interrupted fit resumes.

    Raises:
        InputError: as `fit`.
    """
    types = types_of_views(task.source.record["job"])
    config = task.run.config
    samples, _ = sample_views(task.source, task.run.network, config)
    held_out = task.held_out(samples.label, samples.view)
    best = np.zeros((len(samples), len(task.run.classes)), np.float32)
    arrays: dict[str, NDArray[Any]] = {}

    def report(name: ViewType, k: int, done: int, total: int, metrics: EpochMetrics) -> None:
        number, epochs = VIEW_TYPES.index(name) * config.n_slices + k - 1, task.options.epochs
        note = f"{name}, {k} slices, accuracy {metrics.accuracy:.3f}"
        total_epochs = len(VIEW_TYPES) * config.n_slices * epochs
        task.progress("fit thor", number * epochs + metrics.epoch, total_epochs, note)

    for name in VIEW_TYPES:
        rows = np.flatnonzero([name in types[view] for view in samples.view])
        # A class is trained on the held-out views of a type if it has no others.
        held_of_type = held_out & np.isin(samples.label, samples.label[rows[~held_out[rows]]])
        for k in range(1, config.n_slices + 1):
            context = FitContext("tops", task.run.network, dataclasses.replace(config, n_slices=k))
            checkpoints, shown = Checkpoints(task.scratch / f"{name}-{k}"), partial(report, name, k)
            model, _ = fit(samples, context, task.options, checkpoints, held_of_type, shown, rows=rows)
            arrays |= model_arrays(model, f"{name}-{k}/")
        # Held-out views are not occluded, so they are classified by all slices, as in `THOR`.
        held_rows = rows[held_out[rows]]
        values = sample_probabilities(model, samples, held_rows, context)
        better = values.max(axis=1) > best[held_rows].max(axis=1)
        best[held_rows[better]] = values[better]
    temperature = task.temperature(samples.label, held_out, lambda: best[held_out])
    return StoredBaseline(arrays, temperature)


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
