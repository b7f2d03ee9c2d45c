"""Folds by view."""

from collections.abc import Sequence

import numpy as np
import pytest

import thor2_jax as thor2
from training.fitting.samples import fold_of_views


def fold_of(label: Sequence[int], view: Sequence[int], folds: int, seed: int) -> np.ndarray:
    return fold_of_views(np.array(label), np.array(view), ("a", "b"), folds, seed)


def test_samples_of_a_view_stay_together_and_folds_are_even() -> None:
    label = np.repeat([0, 1, 0], [52, 60, 52])
    view = np.concatenate([np.repeat(np.arange(n, m, s), 4) for n, m, s in ((0, 13, 1), (100, 130, 2), (0, 13, 1))])
    fold_numbers = fold_of(label, view, 5, 0)
    for name in (0, 1):
        folds = {v: set(fold_numbers[(label == name) & (view == v)]) for v in view[label == name]}
        assert all(len(fold) == 1 for fold in folds.values())
        counts = np.bincount([fold.pop() for fold in folds.values()], minlength=5)
        assert len(counts) == 5 and counts.max() - counts.min() <= 1
    np.testing.assert_array_equal(fold_numbers, fold_of(label, view, 5, 0))
    assert (fold_numbers != fold_of(label, view, 5, 1)).any()
    assert not fold_of(label, view, 1, 0).any()
    for folds in (14, 0):
        with pytest.raises(thor2.InputError, match=f"folds is {folds}"):
            fold_of(label, view, folds, 0)
