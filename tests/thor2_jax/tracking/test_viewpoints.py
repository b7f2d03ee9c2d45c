"""Camera poses, merged clouds of several views, and the next view of an object in doubt, on hand-written tables."""

import numpy as np
import pytest
from refusals import assert_refused
from scipy.stats import entropy

from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.tracking.viewpoints import ViewTable, check_pose, merge_views, next_view, read_poses
from training.rendering.camera import camera_pose

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
    for merged in (one, both):
        np.testing.assert_allclose(merged.points.mean(axis=0), views[1][0].points.mean(axis=0), atol=1e-3)
    packed = pack_instances([both, one], 2)  # the rim of the last view is not that of the merged cloud
    assert packed.rim is not None and not packed.rim.any()


CENTRE = np.array([0.3, -0.2, 0.1])


def poses(centre: np.ndarray = CENTRE, start: float = 0.0) -> list[np.ndarray]:
    """Return cameras around a point, from the side."""
    return [camera_pose(start + azimuth, np.pi / 2, centre, 0.8) for azimuth in np.arange(8) * np.pi / 4]


def table(front: np.ndarray) -> ViewTable:
    """Return two classes that look alike from everywhere except from one azimuth of each, a third one that does not.

    Views of azimuth 0 are answered by `front`, those of azimuth pi by certainty, all others by doubt. Calibrated
    probabilities need not sum to 1.
    """
    doubt, sure = np.array([0.48, 0.48, 0.04]), np.eye(3)
    rows = [(label, azimuth) for label in range(2) for azimuth in range(8)]
    answers = [0.3 * front if azimuth == 0 else sure[label] if azimuth == 4 else doubt for label, azimuth in rows]
    rotations = np.array([poses(np.zeros(3))[azimuth][:3, :3] for _, azimuth in rows])
    return ViewTable(np.array([label for label, _ in rows]), rotations, np.array(answers))


def test_the_view_that_tells_the_classes_apart_is_chosen() -> None:
    front = np.array([0.3, 0.3, 0.4])
    for start in (0.0, 1.1):  # the yaw of the object in the world is unknown
        cameras = poses(start=start)
        chosen = next_view(front, CENTRE, cameras[0].round(4), cameras[1:], table(front))
        assert chosen.entropy == pytest.approx(entropy(front))
        assert chosen.index == 3 and chosen.expected[3] < 0.5 < np.delete(chosen.expected, 3).min()


def test_the_expected_entropy_is_a_mean_over_classes() -> None:
    """With one view of a class, every candidate leads to the answer of that view. A class without views is left out."""
    p, answers = np.array([0.5, 0.1, 0.4]), np.array([[0.8, 0.1, 0.1], [0.3, 0.1, 0.6]])
    rotation = poses(np.zeros(3))[0][:3, :3]
    views = ViewTable(np.array([0, 1]), np.stack([rotation, rotation]), answers)
    chosen = next_view(p, CENTRE, poses()[0], poses()[2:4], views)
    posteriors = p * answers / (p * answers).sum(axis=1, keepdims=True)
    mean = p[:2] @ [entropy(row) for row in posteriors] / 0.6
    np.testing.assert_allclose(chosen.expected, mean, rtol=1e-6)
    views = ViewTable(np.zeros(1, int), rotation[None], np.array([[0.6, 0.4]]))
    without = next_view([0.0, 1.0], CENTRE, np.eye(4), [np.eye(4)], views)
    np.testing.assert_allclose(without.expected, without.entropy)  # no view of the only plausible class


def test_bad_input_of_next_view() -> None:
    views, p, here = table(np.array([0.3, 0.3, 0.4])), [0.5, 0.3, 0.2], np.eye(4)
    assert_refused("candidates is empty", next_view, p, CENTRE, here, [], views)
    assert_refused(r"candidates\[1\] is not a rigid motion", next_view, p, CENTRE, here, [here, 2 * here], views)
    assert_refused("pose .* masked", next_view, p, CENTRE, np.ma.masked_equal(here, 1), [here], views)
    for wrong in ([0.5, 0.5], [np.nan, 0.3, 0.2]):
        assert_refused("probabilities", next_view, wrong, CENTRE, here, [here], views)
    assert_refused("centre is .*nan", next_view, p, CENTRE * np.nan, here, [here], views)
