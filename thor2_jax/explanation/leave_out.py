"""Leave-one-out: the decrease of the exact margin without a slice or strip, beside what the attributions predict.

The points of a slice or strip of the first look are removed from all looks. The frames remain those of the
whole cloud, as for the attributions.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from thor2_jax.descriptor.slicing import slices_and_strips
from thor2_jax.explanation.class_scores import ClassScores, OrientedCloud

__all__ = ["LeftOut", "leave_out"]


@dataclasses.dataclass(frozen=True, eq=False)
class LeftOut:
    """Losses of the exact margin of an answer without each slice and each strip.

    Attributes:
        slice_of: [n] int, slice of each point in the first look.
        strip_of: [n] int, strip of each point.
        slices: [S] float32, loss without the slice; NaN if it is empty.
        strips: [S, J] float32, loss without the strip; NaN if it is empty.
        predicted: [S, J] float32, sum of the attributions of the strip; NaN if it is empty.
        agreement: rank correlation (Spearman) of the losses of the strips with their predictions; None if
            there are fewer than three strips or all are equal.
    """

    slice_of: NDArray[np.intp]
    strip_of: NDArray[np.intp]
    slices: NDArray[np.float32]
    strips: NDArray[np.float32]
    predicted: NDArray[np.float32]
    agreement: float | None


def leave_out(scores: ClassScores, cloud: OrientedCloud, index: int, attributions: NDArray[np.float32]) -> LeftOut:
    """Leave out each slice and each strip of an instance in turn.

    Args:
        scores: class scores.
        cloud: the looks at the instance.
        index: number of the answer in `scores.names`.
        attributions: [n] attributions of the points.
    """
    config, n = scores.config, len(attributions)
    points = cloud.aligned.points[0, :n]
    numbers = slices_and_strips(points[:, 0], points[:, 2], cloud.aligned.mask[0, :n], config)
    slice_of, strip_of = (np.asarray(number).astype(np.intp) for number in numbers)
    inside = (slice_of < config.n_slices) & (strip_of < config.n_strips)
    cell_of = np.where(inside, slice_of * config.n_strips + strip_of, -1)
    cells, used_slices = np.unique(cell_of[inside]), np.unique(slice_of[inside])
    masks = [np.ones(n, bool), *(slice_of != k for k in used_slices), *(cell_of != k for k in cells)]
    margins = np.asarray(scores.margin(jnp.asarray(scores.of_masks(cloud, np.array(masks))), index))
    losses = (margins[0] - margins[1:]).astype(np.float32)

    slices = np.full(config.n_slices, np.nan, np.float32)
    slices[used_slices] = losses[: len(used_slices)]
    strips, predicted = np.full((2, config.n_slices * config.n_strips), np.nan, np.float32)
    strips[cells] = losses[len(used_slices) :]
    predicted[cells] = [attributions[cell_of == k].sum() for k in cells]
    varies = len(cells) > 2 and np.ptp(predicted[cells]) > 0 and np.ptp(strips[cells]) > 0
    agreement = float(spearmanr(predicted[cells], strips[cells]).statistic) if varies else None
    grid = config.n_slices, config.n_strips
    return LeftOut(slice_of, strip_of, slices, strips.reshape(grid), predicted.reshape(grid), agreement)
