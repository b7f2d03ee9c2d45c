"""Matching of clouds by their overlap."""

import itertools

import numpy as np
import pytest

from thor2_jax.tracking.tracker import MIN_OVERLAP, VOXELS, match, occupied_voxels, overlap


def patch(x: float, y: float = 0.0, size: float = 0.08, step: float = 0.004) -> np.ndarray:
    """Return a square of points at depth 0.7 m, with a corner at (x, y)."""
    grid = np.mgrid[0:size:step, 0:size:step].reshape(2, -1).T
    return np.column_stack([grid + (x, y), np.full(len(grid), 0.7)]).astype(np.float32)


def test_overlap_is_the_share_of_common_voxels() -> None:
    first, second = patch(0.0), patch(0.03, 0.012, 0.05)
    sets = [[{*map(tuple, (p // size).tolist())} for p in (first, second)] for size in VOXELS]
    shares = [len(a & b) / np.sqrt(len(a) * len(b)) for a, b in sets]
    assert overlap(occupied_voxels(first), occupied_voxels(second)) == pytest.approx(np.mean(shares))
    assert overlap(occupied_voxels(first), occupied_voxels(first + 1)) == 0


def test_a_match_has_the_largest_total_overlap() -> None:
    rng = np.random.default_rng(0)
    first = [occupied_voxels(patch(*rng.uniform(0, 0.2, 2))) for _ in range(4)]
    second = [occupied_voxels(patch(*rng.uniform(0, 0.2, 2))) for _ in range(5)]

    def total(pairs: list[tuple[int, int]]) -> float:
        values = [overlap(first[i], second[j]) for i, j in pairs]
        return sum(value for value in values if value >= MIN_OVERLAP)

    best = max(total(list(enumerate(order))) for order in itertools.permutations(range(5), 4))
    pairs = match(first, second)
    assert total(pairs) == pytest.approx(best) and best > 0.5
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    here, near, beside = (occupied_voxels(patch(*place)) for place in ((0, 0), (0.051, 0.036), (0.055, 0.04)))
    assert match([], second) == match(first, []) == [] and 0.2 < overlap(here, beside) < overlap(here, near) < 0.29
    assert match([here], [beside, near]) == [(0, 1)] and match([here], [beside]) == []


def test_a_small_object_does_not_continue_a_large_one() -> None:
    large, small, occluded = map(occupied_voxels, (patch(0, 0, 0.16), patch(0.14, 0.06, 0.04), patch(0.04, 0.06, 0.06)))
    assert match([large], [small]) == [] and match([large], [small, occluded]) == [(0, 1)]
