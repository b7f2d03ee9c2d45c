"""Smallest changes of the colour or the side lengths of an object that lead to another answer.

Steps along the gradient of the class scores of the relaxed descriptor give directions of change. Along each direction,
the smallest change with another answer is searched for: each changed cloud is recognized, with surfaces and gallery.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.capacity import batch_points
from thor2_jax.config import Relaxation
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import aligned_looks, before_turn
from thor2_jax.explanation.class_scores import ClassScores, jit_gradient
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.types import PointClouds, matmul

__all__ = ["CHANGES", "Change", "Kind", "changed_instance", "smallest_change"]

Kind = Literal["color", "extent"]
CHANGES: tuple[Kind, ...] = ("color", "extent")
"""Kinds of changes."""

Recognize = Callable[[Sequence[PreparedInstance]], Sequence[str]]
"""A function that returns the most probable name of each instance."""

RELAXATION = Relaxation(slice=0.01, strip=0.0025, extremum=0.005, color=4.0)
"""Temperatures at which gradients reflect borders of slices, strips and colour regions at some distance."""

STEPS = 8
"""Number of steps along the gradient."""

STEP = {"color": 0.04, "extent": 0.05}
"""Length of the longest step: of a shift of sRGB in [0, 1], and of logarithms of factors."""

LARGEST = {"color": 0.5, "extent": float(np.log(2))}
"""Largest change that is tried, in the same units."""

SCALES = 24
"""Number of changes that are tried along a direction, equally spaced up to the largest one."""


@dataclasses.dataclass(frozen=True)
class Change:
    """The smallest change of one kind with another answer, as far as the search has found it.

    Attributes:
        kind: "color" for a shift of the sRGB colour of all points, "extent" for a factor for each side of the box.
        values: the shift of red, green and blue in units of 255, or the factors of the sides, longest first.
        size: length of the shift, in units of 255, or the largest relative change of a side.
        answer: the other answer.
        instance: the changed instance.
    """

    kind: Kind
    values: tuple[float, ...]
    size: float
    answer: str
    instance: PreparedInstance


def _axes(instance: PreparedInstance, aligned: ArrayLike, alpha: float) -> NDArray[np.float64]:
    """Return the axes [3, 3] of the box of an instance as rows, longest first, from its aligned points [N, 3].

    They are the rotation that fits the instance to these points (Kabsch, 1976), which compiles nothing.
    """
    placed = np.stack(before_turn(alpha, *np.asarray(aligned, np.float64)[: len(instance.points)].T))
    u, _, vt = np.linalg.svd((placed - placed.mean(axis=1, keepdims=True)) @ instance.points)
    return np.asarray(u @ vt)


def _changed(clouds: PointClouds, axes: NDArray[np.float64], parameters: jax.Array) -> PointClouds:
    """Return clouds after both kinds of changes, whose parameters are [2, 3]; so both need the same programs."""
    shift, factors = parameters
    centre = clouds.points.mean(axis=1, keepdims=True, where=clouds.mask[..., None])
    stretch = matmul(axes.T, jnp.exp(factors)[:, None] * axes)
    moved = centre + matmul(clouds.points - centre, stretch.T)
    points, colors = jnp.where(clouds.mask[..., None], moved, 0), jnp.clip(clouds.colors + shift, 0, 1)
    return dataclasses.replace(clouds, points=points, colors=colors)


def changed_instance(
    instance: PreparedInstance, kind: Kind, parameters: NDArray[np.floating], axes: NDArray[np.floating]
) -> PreparedInstance:
    """Return an instance with another colour or other side lengths.

    Args:
        instance: the instance.
        kind: kind of the change.
        parameters: [3] shift of sRGB in [0, 1], or logarithms of factors along the axes.
        axes: [3, 3] axes of the instance's box as rows.
    """
    if kind == "color":
        shifted = np.clip(instance.colors / 255 + parameters, 0, 1)
        return dataclasses.replace(instance, colors=np.rint(255 * shifted).astype(np.uint8))
    centre = instance.points.mean(axis=0, dtype=np.float64)
    stretch = axes.T @ (np.exp(parameters)[:, None] * axes)
    points = centre + (instance.points - centre) @ stretch.T
    return dataclasses.replace(instance, points=points.astype(np.float32))


@jit_gradient
@jax.value_and_grad
def _lead(parameters: jax.Array, scores: ClassScores, clouds: PointClouds, axes: Any, index: int) -> jax.Array:
    """Return how far the score of a name exceeds those of all others after changes of a cloud, and the gradient.

    If the only enrolled object is the answer, other names are those of trained classes; then this is its score.
    """
    config = dataclasses.replace(scores.config, relaxation=RELAXATION)
    aligned = aligned_looks(_changed(clouds, axes, parameters), config, scores.count)
    (values,) = scores.of_descriptors(scores.describe(aligned, strips(aligned, scores.network, config), config))
    return values[index] - jnp.where(np.arange(len(values)) == index, -np.inf, values).max()


def _gradient_directions(
    scores: ClassScores, clouds: PointClouds, axes: NDArray[np.float64], index: int, kind: Kind
) -> NDArray[np.float64]:
    """Return directions [d, 3] of unit length that lead towards another answer."""
    parameters, path = np.zeros(3), []
    for _ in range(STEPS):
        both = np.array([parameters * (each == kind) for each in CHANGES], np.float32)
        value, gradient = _lead(both, scores, clouds, axes.astype(np.float32), index)
        slope = np.asarray(gradient, np.float64)[CHANGES.index(kind)]
        norm = float(np.linalg.norm(slope))
        if not np.isfinite(norm) or norm == 0:
            break
        length = STEP[kind] if value <= 0 else min(STEP[kind], max(float(value) / norm, STEP[kind] / 4))
        parameters = parameters - length * slope / norm
        path.append(parameters)
    chosen = [path[k] for k in sorted({0, 1, 3, len(path) - 1}) if k < len(path)] if path else []
    return np.array([step / np.linalg.norm(step) for step in chosen if step.any()]).reshape(-1, 3)


def smallest_change(
    scores: ClassScores, recognize: Recognize, instance: PreparedInstance, looks: PointClouds, index: int, kind: Kind
) -> Change | None:
    """Return the smallest change of a kind that gives another answer than the name `index`.

    Args:
        scores: class scores, whose gradients give the directions.
        recognize: function of the whole model, since class scores alone need not determine the answer.
        instance: an instance whose most probable name is `index`.
        looks: the looks at it, see `ClassScores.orient`.
        index: number of the name in `scores.names`.
        kind: kind of the change.

    Returns:
        The change; None if none is found up to a shift of 127 of 255 or a factor of 2.
    """
    axes = _axes(instance, looks.points[0], scores.config.alpha)
    clouds = pack_instances([instance], 1, batch_points([len(instance.points)]))
    directions = _gradient_directions(scores, clouds, axes, index, kind)
    lengths = LARGEST[kind] * np.arange(1, SCALES + 1) / SCALES

    def first_change(tried: NDArray[np.float64]) -> tuple[NDArray[np.float64], str] | None:
        answers = recognize([changed_instance(instance, kind, parameters, axes) for parameters in tried])
        pairs = zip(tried, answers, strict=True)
        return next((pair for pair in pairs if pair[1] != scores.names[index]), None)

    changed = first_change((lengths[:, None, None] * directions).reshape(-1, 3))
    if changed is None:
        return None
    # Refine the length between the last one with the same answer and the first one with another answer.
    step = lengths[0] / np.linalg.norm(changed[0])
    parameters, answer = first_change(changed[0] * (1 - step * np.arange(7, 0, -1) / 8)[:, None]) or changed
    shown = 255 * parameters if kind == "color" else np.exp(parameters)
    size = np.linalg.norm(shown) if kind == "color" else np.abs(shown - 1).max()
    return Change(kind, tuple(shown.tolist()), float(size), answer, changed_instance(instance, kind, parameters, axes))
