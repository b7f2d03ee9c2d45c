"""Clouds of several views, merged in space."""

import numpy as np

from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.tracking.poses import merge_views
from training.rendering.view_sphere import camera_pose


def test_merged_clouds_coincide_in_space() -> None:
    rng = np.random.default_rng(0)
    world = rng.uniform(-0.05, 0.05, (500, 3))
    colors = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    poses = [camera_pose(azimuth, 1.0, np.zeros(3), 0.8) for azimuth in (0.3, 2.0)]
    views = []
    for pose in poses:
        points = ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
        rim = rng.random(500) < 0.2
        views.append((PreparedInstance(1, points, colors, np.zeros(500, bool), rim=rim), pose))
    one, both = merge_views(views[1:], 2.5), merge_views(views, 2.5)
    assert abs(len(both.points) - len(one.points)) < 0.1 * len(one.points)
    np.testing.assert_allclose(both.points.mean(axis=0), one.points.mean(axis=0), atol=1e-3)
    packed = pack_instances([both, one], 2)  # the rim of the last view is not that of the merged cloud
    assert packed.rim is not None and not packed.rim.any()
