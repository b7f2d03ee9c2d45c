"""Benchmarks of adaptation and tracks: summaries, merged clouds and answers, on values written by hand."""

import numpy as np
import pytest

from benchmarks.adaptation import summary
from benchmarks.tracking import METHODS, VIEWS, merged, summarize_scenes
from thor2_jax.recognition.prepared_instance import PreparedInstance
from training.rendering.view_sphere import camera_pose


def test_affected_cameras_are_those_that_lost_enough() -> None:
    rows = {"original": (0.9, 0.9), "dim": (0.86, 0.8), "pale": (0.8, 0.9), "worn": (0.7, 0.74)}
    results = summary({name: {"before": before, "after": after} for name, (before, after) in rows.items()})
    assert results["number of affected cameras"] == 2
    assert results["affected cameras"] == pytest.approx(0.07)
    assert results["all cameras"] == pytest.approx((-0.06 + 0.1 + 0.04) / 3)
    assert results["worst"] == pytest.approx(-0.06) and results["original"] == 0


def test_an_object_keeps_the_answer_of_its_last_view() -> None:
    correct = {method: [False, True] for method in METHODS}
    rows = [
        {"occlusion": "high", "correct": correct},
        {"occlusion": "none", "correct": {method: [True] * VIEWS for method in METHODS}},
    ]
    results = summarize_scenes(rows)
    assert results["all"]["fused"] == {"accuracy": [0.5, *[1.0] * (VIEWS - 1)], "views needed": 2}
    assert results["high"]["objects"] == 1 and results["high"]["merged"]["accuracy"][0] == 0


def test_merged_clouds_coincide_in_space() -> None:
    rng = np.random.default_rng(0)
    world = rng.uniform(-0.05, 0.05, (500, 3))
    colors = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    poses = [camera_pose(azimuth, 1.0, np.zeros(3), 0.8) for azimuth in (0.3, 2.0)]
    views = []
    for pose in poses:
        points = ((world - pose[:3, 3]) @ pose[:3, :3]).astype(np.float32)
        views.append((PreparedInstance(1, points, colors, np.zeros(500, bool)), pose))
    one, both = merged(views[:1], 2.5), merged(views, 2.5)
    assert abs(len(both.points) - len(one.points)) < 0.1 * len(one.points)
    np.testing.assert_allclose(both.points.mean(axis=0), one.points.mean(axis=0), atol=1e-3)
