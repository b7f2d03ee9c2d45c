"""Benchmarks of adaptation and tracks: summaries of values written by hand."""

import pytest

from benchmarks.adaptation import summary
from benchmarks.tracking import METHODS, VIEWS, summarize_scenes


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
