"""Which views are held out: five folds in the paper (section "Training")."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from training.dataset import Samples

__all__ = ["fold_of_samples"]


def fold_of_samples(samples: Samples, folds: int, seed: int) -> NDArray[np.intp]:
    """Fold of each sample, [M], counted from 0: every class's views are dealt to the folds at random, evenly.

    All samples of one view, mirrored and varied, are in one fold: they are nearly the same, and a fold that is held out
    shall not be known from training.

    Args:
        samples: of all views.
        folds: how many; 1 puts all samples in fold 0.
        seed: of the draw.

    Raises:
        InputError: `folds` is not positive, or a class has fewer views than there are folds.
    """
    if folds < 1:
        raise InputError(f"folds is {folds}; it must be at least 1")
    rng = np.random.default_rng(seed)
    fold: NDArray[Any] = np.zeros(len(samples), np.intp)
    for label, name in enumerate(samples.classes):
        mine = samples.label == label
        views, number = np.unique(samples.view[mine], return_inverse=True)
        if len(views) < folds:
            raise InputError(f"folds is {folds}, but class {name!r} has only {len(views)} views")
        fold[mine] = (rng.permutation(len(views)) % folds)[number]
    return fold
