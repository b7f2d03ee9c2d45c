"""Matching of clouds by their overlap."""

import itertools
import tracemalloc

import numpy as np
from numpy.typing import ArrayLike

from thor2_jax.tracking.matching import MIN_OVERLAP, VOXELS, match, overlaps


def patch(x: float, y: float = 0.0, size: float = 0.08, step: float = 0.004) -> np.ndarray:
    """Return a square of points at depth 0.7 m, with a corner at (x, y)."""
    grid = np.mgrid[0:size:step, 0:size:step].reshape(2, -1).T
    return np.column_stack([grid + (x, y), np.full(len(grid), 0.7)]).astype(np.float32)


def test_overlap_is_the_share_of_common_voxels() -> None:
    first, second = patch(0.0), patch(0.03, 0.012, 0.05)
    sets = [[{*map(tuple, (p // size).tolist())} for p in (first, second)] for size in VOXELS]
    shares = [len(a & b) / np.sqrt(len(a) * len(b)) for a, b in sets]
    np.testing.assert_allclose(overlaps([first], [second, first + 1, first]), [[np.mean(shares), 0, 1]])
    assert overlaps([], [first]).shape == (0, 1) and overlaps([], []).shape == (0, 0)


def test_a_match_has_the_largest_total_overlap() -> None:
    rng = np.random.default_rng(0)
    first = [patch(*rng.uniform(0, 0.2, 2)) for _ in range(4)]
    second = [patch(*rng.uniform(0, 0.2, 2)) for _ in range(5)]

    def total(pairs: list[tuple[int, int]], motion: ArrayLike = (0, 0, 0)) -> float:
        shares = overlaps(first, [cloud + np.float32(motion) for cloud in second])
        return sum(shares[pair] for pair in pairs if shares[pair] >= MIN_OVERLAP)

    best = max(total(list(enumerate(order))) for order in itertools.permutations(range(5), 4))
    pairs, motion = match(first, second)
    assert total(pairs, motion) >= best > 0.5
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs)
    here, near, beside = (patch(*place) for place in ((0, 0), (0.051, 0.036), (0.055, 0.04)))
    ((of_beside, of_near),) = overlaps([here], [beside, near])
    assert match([], second)[0] == match(first, [])[0] == [] and 0.2 < of_beside < of_near < 0.29
    assert match([here], [beside, near])[0] == [(0, 1)] and match([here], [beside])[0] == []
    assert match([beside, near], [here])[0] == [(1, 0)] and not match([beside, near], [here])[1].any()


def test_objects_that_move_alike_show_how_the_camera_moved() -> None:
    before = [patch(0), patch(0.3, 0.1, 0.06), patch(0.1, 0.25, 0.12)]
    shift, along_x = np.array([0.07, -0.05, 0.02]), np.array([1, 0, 0])
    now = [cloud + shift + k * 0.005 * along_x for k, cloud in enumerate(before)]
    pairs, motion = match(before, [now[2], patch(0.5), now[0], now[1]])
    assert sorted(pairs) == [(0, 2), (1, 3), (2, 0)]
    np.testing.assert_allclose(motion, -shift - 0.005 * along_x, rtol=0, atol=1e-6)  # the mean
    for moved in ([now[0]], [now[0], *before[1:]], [cloud + 3 * shift for cloud in before]):
        pairs, motion = match(before[: len(moved)], moved)
        assert not motion.any()  # of one object, of a minority, and farther than a camera moves between frames
        assert pairs == [(k, k) for k in range(len(moved)) if moved[k] is before[k]]
    assert not match(before, [cloud + (0, 0, 0.09) for cloud in (patch(0, 0, 0.05), patch(0.3, 0.1, 0.04))])[1].any()
    four = [*before, patch(0.5, 0.5, 0.1)]  # two and two move alike
    pairs, motion = match(four, [cloud + (0.09 if k < 2 else 0.04) * along_x for k, cloud in enumerate(four)])
    assert pairs == [(2, 2), (3, 3)]
    np.testing.assert_allclose(motion, -0.04 * along_x, rtol=0, atol=1e-6)


def test_a_crowd_takes_little_memory() -> None:
    """Each of 400 objects may be one of many neighbours of the same size."""
    crowd = [np.float32([[x, y, 0.7]]) for x in range(20) for y in range(20)]
    before = [np.float32([0.02, 0.02, 1]) * cloud for cloud in crowd]
    tracemalloc.start()
    _, motion = match(before, [cloud + np.float32([0.004, 0, 0.02]) for cloud in before])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    np.testing.assert_allclose(motion, [-0.004, 0, -0.02], rtol=0, atol=1e-3)
    assert peak < 2**26
