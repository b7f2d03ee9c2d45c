"""Paired comparisons, against formulas by hand."""

import math

import numpy as np
import pytest

from benchmarks.paired import paired_difference


def marks(n_both: int, n_first: int, n_second: int, n_none: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [1, N] marks of two methods by the numbers of instances on which both, one or none is correct."""
    first = np.repeat([1, 1, 0, 0], [n_both, n_first, n_second, n_none]).astype(bool)[None]
    second = np.repeat([1, 0, 1, 0], [n_both, n_first, n_second, n_none]).astype(bool)[None]
    return first, second


def test_independent_instances_match_the_formulas() -> None:
    """The interval is about the normal one, and the test counts the instances on which one method is correct."""
    first, second = marks(120, 45, 20, 15)
    result = paired_difference(first, second, np.arange(200))
    difference = np.repeat([0, 1, -1], [135, 45, 20])
    error = difference.std() / math.sqrt(200)
    assert result.difference == pytest.approx(0.125)
    assert result.low == pytest.approx(0.125 - 1.96 * error, abs=0.1 * error)
    assert result.high == pytest.approx(0.125 + 1.96 * error, abs=0.1 * error)
    tail = sum(math.comb(65, k) for k in range(21)) / 2**65
    assert (result.better, result.worse) == (45, 20) and result.p_value == pytest.approx(2 * tail)
    assert result.verdict == "holds"
    reverse = paired_difference(second, first, np.arange(200))
    assert reverse.verdict == "does not hold" and reverse.difference == -result.difference


def test_neighbouring_frames_do_not_narrow_the_interval() -> None:
    first, second = marks(12, 9, 6, 3)
    once = paired_difference(first, second, np.arange(30))
    often = paired_difference(np.repeat(first, 10, axis=1), np.repeat(second, 10, axis=1), np.repeat(np.arange(30), 10))
    assert (often.low, often.high, often.p_value) == (once.low, once.high, once.p_value)
    assert (often.instances, often.placements) == (300, 30) and once.verdict == "undecided"


def test_folds_are_averaged_before_they_are_compared() -> None:
    """Over three folds, a difference of one third counts for the better method, and thirds that cancel for none."""
    first = np.array([[1, 1, 0, 1], [1, 0, 1, 1], [1, 1, 1, 1]], bool)
    second = np.array([[1, 0, 1, 1], [1, 1, 0, 1], [1, 1, 0, 1]], bool)
    result = paired_difference(first, second, np.arange(4))
    assert result.difference == pytest.approx(1 / 12) and (result.better, result.worse) == (1, 0)


def test_equal_methods_and_single_placements_are_undecided() -> None:
    first, second = marks(3, 0, 0, 2)
    result = paired_difference(first, second, np.arange(5))
    assert (result.low, result.high, result.p_value, result.verdict) == (0, 0, 1, "undecided")
    one = paired_difference(*marks(0, 4, 0, 0), np.zeros(4, int))
    assert one.placements == 1 and one.verdict == "undecided"
