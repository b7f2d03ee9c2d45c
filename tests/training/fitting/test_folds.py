"""Folds by view."""

import dataclasses

import numpy as np
import pytest

import thor2_jax as thor2
from training.fitting.folds import fold_of_samples
from training.fitting.samples import Samples


def samples(label: list[int], view: list[int]) -> Samples:
    nothing = {f.name: np.zeros(0) for f in dataclasses.fields(Samples) if f.name not in ("label", "view", "classes")}
    return Samples(label=np.array(label), view=np.array(view), classes=("a", "b"), **nothing)


def test_samples_of_a_view_stay_together_and_folds_are_even() -> None:
    label = np.repeat([0, 1, 0], [52, 60, 52]).tolist()
    view = [*np.repeat(np.arange(13), 4), *np.repeat(np.arange(100, 130, 2), 4), *np.repeat(np.arange(13), 4)]
    given = samples(label, view)
    found = fold_of_samples(given, 5, 0)
    for name in (0, 1):
        folds = {v: set(found[(given.label == name) & (given.view == v)]) for v in given.view[given.label == name]}
        assert all(len(fold) == 1 for fold in folds.values())
        counts = np.bincount([fold.pop() for fold in folds.values()], minlength=5)
        assert len(counts) == 5 and counts.max() - counts.min() <= 1
    np.testing.assert_array_equal(found, fold_of_samples(given, 5, 0))
    assert (found != fold_of_samples(given, 5, 1)).any()


def test_one_fold_holds_all() -> None:
    assert fold_of_samples(samples([0, 0, 1], [3, 4, 3]), 1, 0).tolist() == [0, 0, 0]


def test_too_many_folds() -> None:
    given = samples([0, 0, 0, 1, 1, 1, 1], [0, 1, 2, 0, 0, 1, 1])
    with pytest.raises(thor2.InputError, match="folds is 3, but class 'b' has only 2 views"):
        fold_of_samples(given, 3, 0)
    with pytest.raises(thor2.InputError, match="folds is 0"):
        fold_of_samples(given, 0, 0)
