"""Camera poses against spherical coordinates."""

import math

import numpy as np
import pytest
from refusals import assert_refused

from training.rendering.view_sphere import DISTANCE, camera_pose, view_angles


def test_default_views_are_the_papers() -> None:
    angles = view_angles()
    assert angles.shape == (72 * 37, 2)
    assert angles[0].tolist() == [0, 0] and angles[71] == pytest.approx([math.radians(355), 0])
    assert angles[72] == pytest.approx([0, math.radians(5)]) and angles[-1, 1] == pytest.approx(math.pi)
    assert len(np.unique(angles.round(9), axis=0)) == len(angles)
    for azimuth_step, polar_step, count in ((360, 180, 2), (180, 90, 6), (22.5, 0.9, 16 * 201)):
        assert len(view_angles(azimuth_step, polar_step)) == count


def test_invalid_steps_are_refused() -> None:
    for step in (0.0, -5.0, 7.0, math.nan, math.inf, 400.0, 1e-320):
        assert_refused("^azimuth_step is", view_angles, step, 5.0)
        assert_refused("^polar_step is", view_angles, 5.0, step)
    for steps in ((1e-9, 5), (5, 1e-9), (0.1, 0.1)):  # too many views
        assert_refused("azimuth_step .* polar_step", view_angles, *steps)


@pytest.mark.parametrize(("azimuth", "polar"), [(0, 0), (1.0, 0), (0.3, 1.1), (4.0, 2.5), (2.0, math.pi)])
def test_camera_pose(azimuth: float, polar: float) -> None:
    """The camera looks at the centre; z is up in the image, which is turned by the azimuth at the poles."""
    centre = np.array([0.1, -0.2, 0.3])
    outward = [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)]
    right = [-math.sin(azimuth), math.cos(azimuth), 0]
    pose = camera_pose(azimuth, polar, centre)
    np.testing.assert_allclose(pose[:3, :3].T, [right, np.cross(right, outward), np.negative(outward)], atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], centre + DISTANCE * np.array(outward), atol=1e-12)
    assert pose[3].tolist() == [0, 0, 0, 1] and (pose[2, 1] < 0 or polar in (0, math.pi))
