"""THOR, the predecessor (Samani and Banerjee, "Persistent Homology Meets Object Unity", T-RO 2024; arXiv 2305.03815).

A library of MLPs on TOPS: for each view type (front, side, top) and each number of slices k one that reads the first k.
A type's classifiers are trained on the views of its cameras. Which of them are asked follows from the cloud alone:

- how many slices: if the far end of the cloud is the occluded one, as many as the cloud has, otherwise all;
- which types: from the areas of the three visible faces of the box; one or two types, of which the surer one answers.

The published code tells the case of three different areas of which the middle one faces the camera by the curvature of
the faces; here front and side answer. It also knows which relations of areas each object of its dataset can have; that
is left out.
"""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import OCCLUSION_BIN, turn
from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import MLP
from thor2_jax.types import PointClouds
from training.baselines.baseline import Fitted, Seen, Task
from training.baselines.files import load_arrays, model_arrays
from training.fitting.calibration import sample_probabilities
from training.fitting.checkpoints import Checkpoints
from training.fitting.fit import fit
from training.fitting.options import EpochMetrics
from training.fitting.samples import Samples, build_samples
from training.fitting.steps import FitContext
from training.rendering.view_sphere import view_angles

__all__ = ["THOR", "TYPES", "ViewType", "camera_types", "train_thor", "view_types"]

ViewType = Literal["front", "side", "top"]
TYPES: tuple[ViewType, ...] = ("front", "side", "top")

EQUAL = 0.2
"""Areas count as equal if the smaller one lacks at most this share of the larger."""

Library = Mapping[tuple[ViewType, int], MLP]


def camera_types(azimuth: float, polar: float) -> tuple[ViewType, ...]:
    """Types of a training camera, by its angles in degrees; at their borders two. Cameras on top are of one type."""
    lying = 40 <= polar <= 140
    from_front = min(abs((azimuth - centre + 180) % 360 - 180) for centre in (0, 180))
    from_side = min(abs((azimuth - centre + 180) % 360 - 180) for centre in (90, 270))
    fits = {"front": lying and from_front <= 50, "side": lying and from_side <= 50, "top": polar <= 50 or polar >= 130}
    return tuple(name for name in TYPES if fits[name])


def _equal(a: float, b: float) -> bool:
    return abs(a - b) <= EQUAL * max(a, b)


def view_types(facing: float, second: float, third: float) -> tuple[ViewType, ...]:
    """Types that may answer, by the areas of the visible faces of a cloud's box, first that towards the camera.

    All equal: front. Two others equal: a smaller face is a top, a larger one a front. The face equal to one of the
    others, or none equal: front and side if it is among the larger, side and top if it is among the smaller.
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


@partial(jax.jit, static_argnums=0)
def _forward(graph: Any, state: Any, tops: jax.Array) -> jax.Array:
    return jax.nn.softmax(nnx.merge(graph, state)(tops))


def _areas(normal: PointClouds) -> NDArray[np.float64]:
    """[B, 3] areas of the visible faces, first that towards the camera."""
    points = np.where(np.asarray(normal.mask)[..., None], np.asarray(normal.points), 0).astype(np.float64)
    box = points.max(axis=1)
    sight = np.abs(np.asarray(normal.camera, np.float64) - box / 2)
    # Face k has the other two sides. The two that do not face the camera come in the order of the axes.
    faces = np.stack([box[:, 1] * box[:, 2], box[:, 0] * box[:, 2], box[:, 0] * box[:, 1]], axis=1)
    facing = np.arange(3) == sight.argmax(axis=1)[:, None]
    return np.take_along_axis(faces, np.argsort(~facing, axis=1, kind="stable"), axis=1)


def _far_end_occluded(normal: PointClouds) -> NDArray[np.bool_]:
    """[B], whether the last two x-bins hold more occlusion boundary than the first two."""
    x = np.asarray(normal.points)[..., 0]
    edge = np.asarray(normal.boundary & normal.mask)
    number = np.floor(x / OCCLUSION_BIN)
    last = np.where(np.asarray(normal.mask), number, -1).max(axis=1, keepdims=True)
    return np.asarray((edge & (number >= last - 1)).sum(axis=1) > (edge & (number <= 1)).sum(axis=1))


def _slices(normal: PointClouds, config: DescriptorConfig) -> NDArray[np.intp]:
    """[B], how many slices each cloud has, from 1 to all."""
    aligned = turn(normal, config)
    top = np.where(np.asarray(aligned.mask), np.asarray(aligned.points)[..., 2], 0).max(axis=1)
    return np.clip(np.floor(top / config.sigma_1).astype(np.intp) + 1, 1, config.n_slices)


class THOR:
    """The library, and the choice from it."""

    def __init__(self, library: Library, config: DescriptorConfig) -> None:
        """`library` has a classifier for every type and number of slices of `config`."""
        self._library, self._config = library, config
        self._split: dict[tuple[ViewType, int], Any] = {key: nnx.split(model) for key, model in library.items()}

    def probabilities(self, seen: Seen) -> NDArray[np.float32]:
        """[B, C], those of the surer one of the classifiers that are chosen for a cloud."""
        config, count = self._config, len(seen.tops)
        slices = np.where(_far_end_occluded(seen.normal), _slices(seen.normal, config), config.n_slices).tolist()
        chosen = [view_types(*areas) for areas in _areas(seen.normal).tolist()]
        needed = sorted({(name, k) for types, k in zip(chosen, slices, strict=True) for name in types})
        size = config.image_size**2
        found = {
            key: np.asarray(_forward(*self._split[key], jnp.asarray(seen.tops[:, : key[1] * size]))) for key in needed
        }
        rows = [_surest([found[name, slices[b]][b] for name in chosen[b]]) for b in range(count)]
        return np.stack(rows).astype(np.float32)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Weights as `<type>-<slices>/<path>`."""
        return {
            f"{name}-{k}/{path}": array
            for (name, k), model in self._library.items()
            for path, array in model_arrays(model).items()
        }

    @classmethod
    def with_arrays(cls, arrays: Mapping[str, NDArray[Any]], config: DescriptorConfig, n_classes: int) -> "THOR":
        """The inverse of `arrays`; raises ValueError if some are missing."""
        library = {}
        for name in TYPES:
            for k in range(1, config.n_slices + 1):
                prefix = f"{name}-{k}/"
                mine = {key.removeprefix(prefix): a for key, a in arrays.items() if key.startswith(prefix)}
                model = MLP(k * config.image_size**2, n_classes, rngs=nnx.Rngs(0))
                library[name, k] = load_arrays(model, mine)
        return cls(library, config)


def _surest(rows: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    return max(rows, key=lambda row: float(row.max()))


def _types_of_views(task: Task) -> list[tuple[ViewType, ...]]:
    """Types of the views, by their number."""
    job = task.source.record.get("job")
    if job is None:
        raise InputError("baselines: thor needs the cameras' angles, which only a dataset on disk has (--dataset)")
    degrees = np.rad2deg(view_angles(job["azimuth_step"], job["polar_step"])).round(6)
    return [camera_types(azimuth, polar) for azimuth, polar in degrees.tolist()]


def _part(samples: Samples, rows: NDArray[np.intp]) -> Samples:
    """Some of the samples."""

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


def train_thor(task: Task) -> Fitted:
    """Train the library, each classifier as the run's own; one that was stopped goes on at its last epoch.

    Raises:
        InputError: the source does not tell the angles of its cameras; or as `fit`.
    """
    types = _types_of_views(task)
    config = dataclasses.replace(task.config, homology="closed_form")
    samples = build_samples(task.source, task.network, config)
    held_out = task.held_out(samples.label, samples.view)
    best = np.zeros((len(samples), len(samples.classes)), np.float32)
    library: dict[tuple[ViewType, int], MLP] = {}
    keys = [(name, k) for name in TYPES for k in range(1, config.n_slices + 1)]
    for number, (name, k) in enumerate(keys):
        rows = np.flatnonzero([name in types[view] for view in samples.view])
        part = _part(samples, rows)

        def told(
            done: int, total: int, figures: EpochMetrics, number: int = number, name: str = name, k: int = k
        ) -> None:
            epoch = number * task.options.epochs + figures.epoch
            note = f"{name}, {k} slices, accuracy {figures.accuracy:.3f}"
            task.progress("fit thor", epoch, len(keys) * task.options.epochs, note)

        first = dataclasses.replace(config, n_slices=k)
        with Checkpoints(task.scratch / f"{name}-{k}") as checkpoints:
            marked = held_out[rows]
            context = FitContext("tops", task.network, first)
            model, _ = fit(part, context, task.options, checkpoints, marked if marked.any() else None, told)
        library[name, k] = model
        if k == config.n_slices:
            asked = rows[marked]
            said = sample_probabilities(model, part, np.flatnonzero(marked), context)
            surer = said.max(axis=1) > best[asked].max(axis=1)
            best[asked[surer]] = said[surer]
    return Fitted(THOR(library, task.config), best[held_out], samples.label[held_out])
