"""THOR: the rules that select classifiers, and the predictions of the library."""

import itertools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flax import nnx
from small_runs import random_classifier

import thor2_jax as thor2
from thor2_jax.networks.networks import model_arrays
from training.baselines.baseline import BaselineInputs
from training.baselines.thor import VIEW_TYPES, camera_types, load_thor, view_types

pytestmark = pytest.mark.usefixtures("small_classifiers")

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=3, image_size=4)


def test_camera_types_match_the_published_lists() -> None:
    """Compare all cameras of the published training, in steps of 5 degrees."""
    lying = set(range(40, 145, 5))
    front = set(range(0, 55, 5)) | set(range(130, 235, 5)) | set(range(310, 360, 5))
    side = set(range(40, 145, 5)) | set(range(220, 325, 5))
    top = set(range(0, 55, 5)) | set(range(130, 185, 5))
    for azimuth, polar in itertools.product(range(0, 360, 5), range(0, 185, 5)):
        expected = (azimuth in front and polar in lying, azimuth in side and polar in lying, polar in top)
        assert camera_types(azimuth, polar) == tuple(np.array(VIEW_TYPES)[list(expected)])


def test_view_types_by_face_areas() -> None:
    for types, areas in (
        (("front",), [(1, 1, 1), (0.8, 1, 1), (1, 0.5, 0.5)]),
        (("front", "side"), [(1, 1, 0.5), (1, 0.5, 1), (1, 0.7, 0.3), (0.7, 0.3, 1)]),
        (("side", "top"), [(0.5, 0.5, 1), (0.5, 1, 0.5), (0.3, 0.7, 1)]),
        (("top",), [(0.79, 1, 1)]),
    ):
        assert {view_types(*each) for each in areas} == {types}


def box(size: Sequence[float], camera: Sequence[float], edge: float | None = None) -> tuple[Any, Any, Any]:
    """Return points of a normalized box, its camera and its occlusion boundary, which lies at x = edge."""
    xyz = np.array(list(itertools.product(*(np.linspace(0, side, 9) for side in size))), np.float32)
    return xyz, camera, np.zeros(len(xyz), bool) if edge is None else np.isclose(xyz[:, 0], edge)


def test_most_confident_selected_classifier_decides() -> None:
    """Boxes of 0.2 x 0.1 x 0.05 have faces of 0.005 (x), 0.01 (y) and 0.02 (z); rotated, they have two slices."""
    size = (0.2, 0.1, 0.05)
    boxes = (
        box(size, (0.1, 0.05, -3.0)),  # largest face: front and side, all slices
        box(size, (-3.0, 0.05, 0.0)),  # smallest face: side and top
        box(size, (0.1, 0.05, -3.0), edge=size[0]),  # the far end is occluded: two slices
        box(size, (0.1, 0.05, -3.0), edge=0.0),  # the near end is occluded
        box((0.1, 0.1, 0.1), (0.0, -2.0, 0.0)),  # all equal: front
        (np.zeros((0, 3), np.float32), (0.0, 0.0, 0.0), None),  # no points
    )
    points, cameras, boundaries = zip(*boxes, strict=True)
    clouds = [(xyz, np.zeros_like(xyz)) for xyz in points]
    normal = thor2.PointClouds.pack(clouds, camera=np.array(cameras), boundary=boundaries)
    inputs = BaselineInputs(normal, np.random.default_rng(0).random((6, 48)).astype(np.float32), None)
    pairs = enumerate(itertools.product(VIEW_TYPES, (1, 2, 3)))
    models = {(name, k): random_classifier(16 * k, 4, seed) for seed, (name, k) in pairs}
    arrays = {path: a for (name, k), each in models.items() for path, a in model_arrays(each, f"{name}-{k}/").items()}
    selected = [("front side", 3), ("side top", 3), ("front side", 2), ("front side", 3), ("front", 3)]
    run = SimpleNamespace(config=CONFIG, classes=("",) * 4)
    probabilities = load_thor(arrays, run)(inputs)
    assert probabilities.shape == (6, 4) and np.isfinite(probabilities).all()
    apply = nnx.jit(lambda model, tops: nnx.softmax(model(tops)))
    for row, (names, k) in enumerate(selected):
        tops = inputs.tops[row : row + 1, : 16 * k]
        rows = [np.asarray(apply(models[name, k], tops))[0] for name in names.split()]
        np.testing.assert_allclose(probabilities[row], max(rows, key=np.max), atol=1e-6)
    del arrays["side-2/head/bias"]
    with pytest.raises(ValueError, match="head/bias"):
        load_thor(arrays, run)
