"""THOR, the predecessor (Samani and Banerjee, "Persistent Homology Meets Object Unity", T-RO 2024; arXiv 2305.03815).

THOR is a library of MLPs on TOPS: one for each view type (front, side, top) and each number of slices k, which reads
the first k slices. The classifiers of a type are trained on the views of that type's cameras. Two rules select the
classifiers for a cloud:

- number of slices: the number of slices of the cloud if its far end is occluded, otherwise all slices;
- view types: one or two, from the areas of the three visible faces of the bounding box. With two classifiers, the more
  confident one determines the class.

Two parts of the published code are left out. If all areas differ and the middle one faces the camera, the published
code decides by the curvature of the faces; here, both front and side are used. It also contains a table of the area
relations that each object of its dataset can have.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax import DescriptorConfig, InputError, PointClouds
from thor2_jax.descriptor.view_normalization import OCCLUSION_BIN, turn
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import MLP, model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs, FitTask, Predictor, StoredBaseline, compiled_network
from training.fitting.fit import FitContext, fit, sample_probabilities
from training.fitting.loop import Checkpoints, EpochMetrics
from training.fitting.samples import sample_views
from training.rendering.camera import view_angles

__all__ = ["VIEW_TYPES", "camera_types", "fit_thor", "load_thor", "types_of_views", "view_types"]

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
    from_front = abs((azimuth + 90) % 180 - 90)  # degrees to the nearest of front (0) and back (180)
    fits = {"front": lying and from_front <= 50, "side": lying and from_front >= 40, "top": polar <= 50 or polar >= 130}
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
