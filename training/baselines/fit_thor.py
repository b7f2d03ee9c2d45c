"""Fitting the library of classifiers of THOR."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.model.classifier import MLP
from training.baselines.task import FitTask, FittedBaseline
from training.baselines.thor import THOR, VIEW_TYPES, ViewType
from training.fitting.calibration import sample_probabilities
from training.fitting.checkpoints import Checkpoints
from training.fitting.fit import fit
from training.fitting.options import EpochMetrics
from training.fitting.samples import Samples, build_samples
from training.fitting.steps import FitContext
from training.rendering.view_sphere import view_angles

__all__ = ["camera_types", "fit_thor"]


def camera_types(azimuth: float, polar: float) -> tuple[ViewType, ...]:
    """Return the view types of a training camera at these angles, degrees; two where the ranges overlap."""
    lying = 40 <= polar <= 140
    from_front = min(abs((azimuth - centre + 180) % 360 - 180) for centre in (0, 180))
    from_side = min(abs((azimuth - centre + 180) % 360 - 180) for centre in (90, 270))
    fits = {"front": lying and from_front <= 50, "side": lying and from_side <= 50, "top": polar <= 50 or polar >= 130}
    return tuple(name for name in VIEW_TYPES if fits[name])


def fit_thor(task: FitTask) -> FittedBaseline:
    """Fit the library, each classifier in the same way as the run's own; an interrupted fit resumes.

    Raises:
        InputError: the camera angles of the source are unknown; or as `fit`.
    """
    types = _types_of_views(task)
    config = dataclasses.replace(task.config, homology="closed_form")
    samples = build_samples(task.source, task.network, config)
    held_out = task.held_out(samples.label, samples.view)
    best = np.zeros((len(samples), len(samples.classes)), np.float32)
    library: dict[tuple[ViewType, int], MLP] = {}
    for name in VIEW_TYPES:
        rows = np.flatnonzero([name in types[view] for view in samples.view])
        subset, marks = _subset(samples, rows), held_out[rows]
        for k in range(1, config.n_slices + 1):
            library[name, k] = _fit_classifier(task, config, subset, marks, name, k)
        # Held-out views are not occluded: they are classified by all slices, as `THOR` does.
        context = FitContext("tops", task.network, config)
        values = sample_probabilities(library[name, config.n_slices], subset, np.flatnonzero(marks), context)
        held_rows = rows[marks]
        better = values.max(axis=1) > best[held_rows].max(axis=1)
        best[held_rows[better]] = values[better]
    return FittedBaseline(THOR(library, task.config), best[held_out], samples.label[held_out])


def _fit_classifier(
    task: FitTask, config: DescriptorConfig, samples: Samples, held_out: NDArray[np.bool_], name: ViewType, k: int
) -> MLP:
    """Fit the classifier of one view type on the first `k` slices."""
    number, epochs = VIEW_TYPES.index(name) * config.n_slices + k - 1, task.options.epochs

    def report(done: int, total: int, metrics: EpochMetrics) -> None:
        note = f"{name}, {k} slices, accuracy {metrics.accuracy:.3f}"
        total_epochs = len(VIEW_TYPES) * config.n_slices * epochs
        task.progress("fit thor", number * epochs + metrics.epoch, total_epochs, note)

    context = FitContext("tops", task.network, dataclasses.replace(config, n_slices=k))
    with Checkpoints(task.scratch / f"{name}-{k}") as checkpoints:
        marks = held_out if held_out.any() else None
        return fit(samples, context, task.options, checkpoints, marks, report)[0]


def _types_of_views(task: FitTask) -> list[tuple[ViewType, ...]]:
    """Return the view types of each view number."""
    job = task.source.record.get("job")
    if job is None:
        raise InputError("baselines: thor needs the camera angles of the views; give a rendered dataset with --dataset")
    degrees = np.rad2deg(view_angles(job["azimuth_step"], job["polar_step"])).round(6)
    return [camera_types(azimuth, polar) for azimuth, polar in degrees.tolist()]


def _subset(samples: Samples, rows: NDArray[np.intp]) -> Samples:
    """Return the samples of these rows."""

    def entries(start: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        counts = np.diff(start)[rows]
        ends = np.concatenate([[0], np.cumsum(counts)])
        return ends, np.repeat(start[rows] - ends[:-1], counts) + np.arange(ends[-1])

    strip_start, strips = entries(samples.strip_start)
    color_start, colors = entries(samples.color_start)
    return Samples(
        strip_start=strip_start,
        color_start=color_start,
        strip=samples.strip[strips],
        length=samples.length[strips],
        color_strip=samples.color_strip[colors],
        color_set=samples.color_set[colors],
        color_count=samples.color_count[colors],
        label=samples.label[rows],
        view=samples.view[rows],
        classes=samples.classes,
    )
