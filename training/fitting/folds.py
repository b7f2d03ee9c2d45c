"""Cross-validation folds: five in the paper (section "Training")."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError

__all__ = ["fold_of_views"]


def fold_of_views(
    label: NDArray[np.integer[Any]], view: NDArray[np.integer[Any]], classes: Sequence[str], folds: int, seed: int
) -> NDArray[np.intp]:
    """Return the fold of each cloud [M], from 0: the views of every class are assigned at random and evenly.

    All clouds of a view (mirrored and augmented copies) are in the same fold: they are nearly equal, and the held-out
    set must not be known from training.

    Args:
        label: [M], index into `classes`.
        view: [M], index of the view among the views of its object.
        classes: class names.
        folds: number of folds; with 1, everything is in fold 0.
        seed: seed for the assignment.

    Raises:
        InputError: `folds` is not positive, or a class has fewer views than folds.
    """
    if folds < 1:
        raise InputError(f"folds is {folds}; it must be at least 1")
    rng = np.random.default_rng(seed)
    fold: NDArray[Any] = np.zeros(len(label), np.intp)
    for index, name in enumerate(classes):
        members = label == index
        views, number = np.unique(view[members], return_inverse=True)
        if len(views) < folds:
            raise InputError(f"folds is {folds}; class {name!r} has {len(views)} views; use at most that many folds")
        fold[members] = (rng.permutation(len(views)) % folds)[number]
    return fold
