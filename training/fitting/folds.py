"""Which views are held out: five folds in the paper (section "Training")."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError

__all__ = ["fold_of_views"]


def fold_of_views(
    label: NDArray[np.integer[Any]], view: NDArray[np.integer[Any]], classes: Sequence[str], folds: int, seed: int
) -> NDArray[np.intp]:
    """Fold of each cloud, [M], counted from 0: every class's views are dealt to the folds at random, evenly.

    All clouds of one view are in one fold: they are nearly the same, and a fold that is held out shall not be known
    from training. How many clouds a view has does not matter.

    Args:
        label: [M], index into `classes`.
        view: [M], number of the view of its object.
        classes: names.
        folds: how many; 1 puts everything in fold 0.
        seed: of the draw.

    Raises:
        InputError: `folds` is not positive, or a class has fewer views than there are folds.
    """
    if folds < 1:
        raise InputError(f"folds is {folds}; it must be at least 1")
    rng = np.random.default_rng(seed)
    fold: NDArray[Any] = np.zeros(len(label), np.intp)
    for index, name in enumerate(classes):
        mine = label == index
        views, number = np.unique(view[mine], return_inverse=True)
        if len(views) < folds:
            raise InputError(f"folds is {folds}, but class {name!r} has only {len(views)} views")
        fold[mine] = (rng.permutation(len(views)) % folds)[number]
    return fold
