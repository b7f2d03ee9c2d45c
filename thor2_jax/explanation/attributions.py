"""Attributions: how much each point of a cloud contributes to an answer (Sundararajan et al. 2017).

Every point has a weight in the relaxed descriptor. The attribution of a point is the gradient of the answer's margin
with respect to its weight, averaged while the weights of all points increase together to 1 (integrated gradients). The
frames of the looks, and the histogram of balanced colours in galleries, are held constant. To first order, the
attribution is the decrease of the margin when the point is removed.

`leave_out` checks the attributions exactly: it computes the decrease of the margin without each slice and strip of the
first look. The points are removed from all looks, whose frames remain those of the whole cloud, as for attributions.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.stats import spearmanr

from thor2_jax.config import Relaxation
from thor2_jax.descriptor.slicing import region_sets, relaxed_strips, slices_and_strips
from thor2_jax.explanation.class_scores import ClassScores, jit_gradient
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.types import PointClouds, Strips

__all__ = ["Attributions", "LeftOut", "attribute_points", "leave_out", "select_points", "tenth_of"]

RELAXATION = Relaxation(slice=0.001, strip=0.00025, extremum=0.005, color=0.1)
"""Temperatures, chosen on tuning frames. They are small except for the extremes, since the weights of points have
gradients even with hard slices, strips and colour regions."""

STEPS = 8
"""Number of steps on the path, on which the weights increase from 1/2 to 1."""

PATHS = (8, 3, 1)
"""Numbers of last steps over which gradients are averaged: from weights of 1/2, from weights of 4/5, and at the end."""

SMOOTHING = (0.005, 0.015)
"""Standard deviations of the Gaussians with which attributions are also averaged over neighbours, metres. A strip
depends only on its outermost points, but without them the next points replace them, so smoothing spreads attributions
over patches of the surface. The path and smoothing are chosen whose most attributed tenth lowers the exact margin
most."""

RANDOM_TENTHS = 20


@dataclasses.dataclass(frozen=True, eq=False)
class Attributions:
    """The attributions of a cloud's points to its answer, with an exact check.

    For the check, recognition is repeated completely without a tenth of the points.

    Attributes:
        values: [n] float32, loss of margin without each point, to first order; negative values oppose the answer.
        margin: margin with all points.
        most_attributed: loss of margin without the most attributed tenth.
        random: mean loss of margin without random tenths.
    """

    values: NDArray[np.float32]
    margin: float
    most_attributed: float
    random: float

    @property
    def holds(self) -> bool:
        """Whether the most attributed tenth matters more than random ones."""
        return self.most_attributed > self.random


def tenth_of(n_points: int) -> int:
    """Return the number of points in a tenth of a cloud, at least one."""
    return max(1, round(n_points / 10))


def select_points(instance: PreparedInstance, kept: NDArray[np.bool_ | np.intp]) -> PreparedInstance:
    """Return the instance with only some points, which are given by a mask [n] or by their numbers."""
    points, colors = instance.points[kept], instance.colors[kept]
    rim = None if instance.rim is None else instance.rim[kept]
    return dataclasses.replace(instance, points=points, colors=colors, boundary=instance.boundary[kept], rim=rim)


@jit_gradient
@jax.grad
def _gradients(weights: jax.Array, scores: ClassScores, looks: PointClouds, index: int) -> Any:
    """Return the gradients [T, N] of the margins of T versions of a cloud, of K looks each, by the weights [T, N]."""
    config = dataclasses.replace(scores.config, relaxation=RELAXATION)

    def one(cloud: PointClouds, weight: jax.Array) -> Strips:
        return relaxed_strips(cloud.points.T, cloud.colors, cloud.mask, region_sets(scores.network), config, weight)

    each = jax.lax.map(lambda weight: jax.vmap(one, in_axes=(0, None))(looks, weight), weights)
    cut = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), each)
    oriented = scores.describe(scores.repeat(looks, len(weights)), cut, config)
    return scores.margin(scores.of_descriptors(oriented), index).sum()


def path_gradients(scores: ClassScores, looks: PointClouds, index: int) -> NDArray[np.float32]:
    """Return the gradients [STEPS, N] of a name's relaxed margin with respect to the points' weights along the path.

    Args:
        scores: class scores.
        looks: the looks at the instance, see `ClassScores.orient`.
        index: number of the name.
    """
    levels = ((1 + (np.arange(STEPS) + 0.5) / STEPS) / 2).astype(np.float32)
    return np.asarray(_gradients(np.repeat(levels[:, None], looks.mask.shape[1], axis=1), scores, looks, index))


def smooth(points: NDArray[np.float32], values: NDArray[np.float32], deviation: float) -> NDArray[np.float32]:
    """Return the averages of the values [m, n] of n points over their neighbours, weighted by a Gaussian of distance.

    Args:
        points: [n, 3] metres.
        values: [m, n].
        deviation: standard deviation of the Gaussian, metres; neighbours are at most twice as far.
    """
    tree = KDTree(points)
    near = tree.sparse_distance_matrix(tree, 2 * deviation, output_type="coo_matrix").tocsr()
    # The distance of each point to itself, 0, is stored, too.
    near.data = np.exp(-np.square(near.data / deviation) / 2)
    sums = near @ np.vstack([values, np.ones(len(points))]).T
    return (sums[:, :-1] / sums[:, -1:]).T.astype(np.float32)


def attribute_points(scores: ClassScores, looks: PointClouds, instance: PreparedInstance, index: int) -> Attributions:
    """Attribute the margin of a name to the points of an instance.

    Args:
        scores: class scores.
        looks: the looks at the instance, see `ClassScores.orient`.
        instance: the instance.
        index: number of the name in `scores.names`.
    """
    n = len(instance.points)
    gradients = path_gradients(scores, looks, index)[:, :n]
    averages = np.stack([gradients[-count:].mean(axis=0) for count in PATHS])
    smoothed = [smooth(instance.points, averages, deviation) for deviation in SMOOTHING]
    candidates = np.concatenate([averages, *smoothed])
    tenths = [np.argsort(-values, kind="stable")[: tenth_of(n)] for values in candidates]
    rng = np.random.default_rng(0)
    tenths += [rng.choice(n, tenth_of(n), replace=False) for _ in range(RANDOM_TENTHS)]
    rests = [select_points(instance, np.delete(np.arange(n), tenth)) for tenth in tenths]
    exact = scores.of_instances([instance, *rests])
    margins = scores.margin(exact, index)
    losses = margins[0] - margins[1:]
    best = int(losses[: len(candidates)].argmax())
    random = float(losses[len(candidates) :].mean())
    return Attributions(candidates[best], float(margins[0]), float(losses[best]), random)


@dataclasses.dataclass(frozen=True, eq=False)
class LeftOut:
    """Losses of the exact margin of an answer without each slice and each strip.

    Attributes:
        slices: [S] float32, loss without the slice; NaN if it is empty.
        strips: [S, J] float32, loss without the strip; NaN if it is empty.
        predicted: [S, J] float32, sum of the attributions in the strip; NaN if it is empty.
        agreement: rank correlation (Spearman) of the losses of the strips with their predictions; None if
            there are fewer than three strips or all values are equal.
    """

    slices: NDArray[np.float32]
    strips: NDArray[np.float32]
    predicted: NDArray[np.float32]
    agreement: float | None


def leave_out(scores: ClassScores, looks: PointClouds, index: int, attributions: NDArray[np.float32]) -> LeftOut:
    """Compute the margin without each slice and without each strip of an instance.

    Args:
        scores: class scores.
        looks: the looks at the instance.
        index: number of the answer in `scores.names`.
        attributions: [n] attributions of the points.
    """
    config, n = scores.config, len(attributions)
    x, _, z = looks.points[0, :n].T
    slice_of, strip_of = map(np.asarray, slices_and_strips(x, z, looks.mask[0, :n], config))
    inside = (slice_of < config.n_slices) & (strip_of < config.n_strips)
    cell_of = np.where(inside, slice_of * config.n_strips + strip_of, -1)
    cells, used_slices = np.unique(cell_of[inside]), np.unique(slice_of[inside])
    masks = [np.ones(n, bool), *(slice_of != k for k in used_slices), *(cell_of != k for k in cells)]
    margins = scores.margin(scores.of_masks(looks, np.array(masks)), index)
    losses = (margins[0] - margins[1:]).astype(np.float32)

    slices = np.full(config.n_slices, np.nan, np.float32)
    slices[used_slices] = losses[: len(used_slices)]
    strips, predicted = np.full((2, config.n_slices * config.n_strips), np.nan, np.float32)
    strips[cells] = losses[len(used_slices) :]
    predicted[cells] = [attributions[cell_of == k].sum() for k in cells]
    varies = len(cells) > 2 and np.ptp(predicted[cells]) > 0 and np.ptp(strips[cells]) > 0
    agreement = float(spearmanr(predicted[cells], strips[cells]).statistic) if varies else None
    return LeftOut(slices, strips.reshape(len(slices), -1), predicted.reshape(len(slices), -1), agreement)
