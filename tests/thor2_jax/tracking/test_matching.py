"""Matching of clouds by their overlap, camera poses, and clouds of several views, merged in space."""

import itertools

import numpy as np
import pytest
from refusals import assert_refused

from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.tracking.tracker import MIN_OVERLAP, VOXELS, match, occupied_voxels, overlap
from thor2_jax.tracking.viewpoints import check_pose, merge_views, read_poses
from training.rendering.camera import camera_pose


def patch(x: float, y: float = 0.0, size: float = 0.08, step: float = 0.004) -> np.ndarray:
    """Return a square of points at depth 0.7 m, with a corner at (x, y)."""
    grid = np.mgrid[0:size:step, 0:size:step].reshape(2, -1).T
    return np.column_stack([grid + (x, y), np.full(len(grid), 0.7)]).astype(np.float32)


def test_overlap_is_the_share_of_common_voxels() -> None:
    first, second = patch(0.0), patch(0.03, 0.012, 0.05)
    shares = []
    for size in VOXELS:
        a, b = ({tuple(v) for v in np.floor(p / size).astype(int).tolist()} for p in (first, second))
        shares.append(len(a & b) / min(len(a), len(b)))
    assert overlap(occupied_voxels(first), occupied_voxels(second)) == pytest.approx(np.mean(shares))
    assert overlap(occupied_voxels(first), occupied_voxels(first + 1)) == 0
    assert overlap(occupied_voxels(first), occupied_voxels(first[:0])) == 0


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
    assert match([], second) == match(first, []) == []


NO_MOTIONS = (
    *(np.eye(3), "x", np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), np.diag([1.0, 1, -1, 1])),
    *(np.eye(4) + np.eye(4, k=-3) * 0.5, [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
)


@pytest.mark.parametrize("pose", NO_MOTIONS)
def test_a_pose_that_is_no_rigid_motion_is_refused(pose: object) -> None:
    is_nan = np.shape(pose) == (4, 4) and np.isnan(pose).any()
    assert_refused("^poses is 'a.x00b'; expected a path", read_poses, "a\0b", [])
    assert_refused("pose has NaN" if is_nan else "pose (has shape|is not)", check_pose, pose, "camera_pose")


@pytest.mark.parametrize("middle", [(0, 0, 0), (500_000, 4_000_000, 100)])
def test_merged_clouds_coincide_in_space(middle: tuple[float, ...]) -> None:
    """The coordinates of the world may be those of a map."""
    rng = np.random.default_rng(0)
    world = rng.uniform(-0.05, 0.05, (500, 3)) + middle
    colors = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    poses = [camera_pose(azimuth, 1.0, np.array(middle, float), 0.8) for azimuth in (0.3, 2.0)]
    views = []
    for pose in poses:
        points = ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
        rim = rng.random(500) < 0.2
        views.append((PreparedInstance(1, points, colors, np.zeros(500, bool), rim=rim), pose))
    one, both = merge_views(views[1:], 2.5), merge_views(views, 2.5)
    assert abs(len(both.points) - len(one.points)) < 0.1 * len(one.points)
    np.testing.assert_allclose(both.points.mean(axis=0), one.points.mean(axis=0), atol=1e-3)
    for merged in (one, both):
        np.testing.assert_allclose(merged.points.mean(axis=0), views[1][0].points.mean(axis=0), atol=2e-3)
    packed = pack_instances([both, one], 2)  # the rim of the last view is not that of the merged cloud
    assert packed.rim is not None and not packed.rim.any()
