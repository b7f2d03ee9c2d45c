"""The next view of an object in doubt, on tables of views that are written by hand."""

import numpy as np
import pytest
from refusals import assert_refused
from scipy.stats import entropy

from thor2_jax.tracking.viewpoints import ViewTable, next_view
from training.rendering.camera import camera_pose

CENTRE = np.array([0.3, -0.2, 0.1])


def poses(centre: np.ndarray = CENTRE, start: float = 0.0) -> list[np.ndarray]:
    """Return cameras around a point, from the side."""
    return [camera_pose(start + azimuth, np.pi / 2, centre, 0.8) for azimuth in np.arange(8) * np.pi / 4]


def table(front: np.ndarray) -> ViewTable:
    """Return two classes that look alike from everywhere except from one azimuth of each, a third one that does not.

    Views of azimuth 0 are answered by `front`, those of azimuth pi by certainty, all others by doubt.
    """
    doubt, sure = np.array([0.48, 0.48, 0.04]), np.eye(3)
    rows = [(label, azimuth) for label in range(2) for azimuth in range(8)]
    answers = [front if azimuth == 0 else sure[label] if azimuth == 4 else doubt for label, azimuth in rows]
    rotations = np.array([poses(np.zeros(3))[azimuth][:3, :3] for _, azimuth in rows])
    return ViewTable(np.array([label for label, _ in rows]), rotations, np.array(answers))


def test_the_view_that_tells_the_classes_apart_is_chosen() -> None:
    front = np.array([0.3, 0.3, 0.4])
    for start in (0.0, 1.1):  # the yaw of the object in the world is unknown
        cameras = poses(start=start)
        chosen = next_view(front, CENTRE, cameras[0], cameras[1:], table(front))
        assert chosen.index == 3
        assert chosen.entropy == pytest.approx(entropy(front))
        assert chosen.expected.argmin() == 3 and chosen.expected[3] < 0.5 < np.delete(chosen.expected, 3).min()


def test_the_expected_entropy_is_a_mean_over_classes() -> None:
    """With one view of each class, every candidate leads to the answer of that view."""
    p, answers = np.array([0.6, 0.4]), np.array([[0.9, 0.1], [0.3, 0.7]])
    rotation = poses(np.zeros(3))[0][:3, :3]
    views = ViewTable(np.arange(2), np.stack([rotation, rotation]), answers)
    chosen = next_view(p, CENTRE, poses()[0], poses()[2:4], views)
    posteriors = p * answers / (p * answers).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(chosen.expected, p @ [entropy(row) for row in posteriors], rtol=1e-6)
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
