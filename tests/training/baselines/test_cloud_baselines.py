"""THOR by its rules, the random forest against NumPy and scikit-learn, and PointNet against a NumPy reference."""

import itertools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flax import nnx
from sklearn.ensemble import RandomForestClassifier
from small_clouds import CLOSED, NETWORK, random_clouds
from small_runs import random_classifier

import thor2_jax as thor2
from thor2_jax.networks.networks import model_arrays
from training.baselines import cloud_baselines as module
from training.baselines.baseline import BaselineInputs, Predictor

pytestmark = pytest.mark.usefixtures("small_classifiers")


def normal(sizes: tuple[int, ...]) -> thor2.PointClouds:
    clouds = [(xyz - xyz.min(axis=0) if len(xyz) else xyz, rgb) for xyz, rgb in random_clouds(1, sizes)]
    return thor2.view_normalize(thor2.PointClouds.pack(clouds, camera=[0, 0, -3]), CLOSED)


def test_features_match_numpy() -> None:
    clouds = normal((400, 1, 0, 57))
    features = module.forest_features(clouds, NETWORK, CLOSED)
    assert features.shape == (4, 22 + 3 + 14)
    aligned = np.asarray(thor2.turn(clouds, CLOSED).points, np.float64)
    points, mask = np.asarray(clouds.points, np.float64), np.asarray(clouds.mask)
    colors = np.rint(np.asarray(clouds.colors) * 255).astype(np.uint8)
    for row, (n, expected) in enumerate(zip((400, 1, 0, 57), features, strict=True)):
        here = mask[row]
        assert here.sum() == n
        if not n:
            np.testing.assert_array_equal(expected, 0)
            continue
        np.testing.assert_allclose(expected[:22], NETWORK.membership(colors[row, here]).mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(expected[22:25], points[row, here].max(axis=0), rtol=1e-6)
        x, y, z = aligned[row, here].T
        for k in range(7):
            inside = np.floor(z / CLOSED.sigma_1) == k
            strips = np.floor(x[inside] / CLOSED.sigma_2)
            wide = (np.ptp(strips) + 1) * CLOSED.sigma_2 if inside.any() else 0
            deep = np.ptp(y[inside]) if inside.any() else 0
            assert expected[25 + k] == pytest.approx(wide, abs=1e-6)
            assert expected[32 + k] == pytest.approx(deep, abs=1e-6)


@pytest.mark.parametrize(("depth", "scale"), [(None, 1), (1, 1), (None, 0)])
def test_predictions_match_scikit_learn(depth: int | None, scale: int) -> None:
    """The trees have many leaves, two leaves, or, for equal features, a single one."""
    rng = np.random.default_rng(0)
    x = scale * rng.random((300, 5)).astype(np.float32)
    y = rng.integers(0, 4, 300) if scale == 0 else (x[:, 0] * 3).astype(int) + (x[:, 1] > 0.5)
    grown = RandomForestClassifier(9, min_samples_leaf=2, max_depth=depth, random_state=0).fit(x, y)
    features = np.concatenate([x, rng.random((50, 5)).astype(np.float32)])
    np.testing.assert_allclose(
        module.predict_forest(module.tree_arrays(grown), features), grown.predict_proba(features), atol=1e-6
    )


ARRAYS = model_arrays(module.PointNet(5, rngs=nnx.Rngs(3)))


def pointnet(classes: int = 5) -> Predictor:
    return module.load_pointnet(ARRAYS, SimpleNamespace(classes=("",) * classes))  # type: ignore[arg-type]


def inputs(sizes: tuple[int, ...]) -> BaselineInputs:
    return BaselineInputs(thor2.PointClouds.pack(random_clouds(0, sizes)), None, None)


def test_probabilities_match_numpy() -> None:
    """The cloud has as many points as are sampled, so all of them are used."""
    cloud = inputs((module.POINTS,))
    arrays = {name: array.astype(np.float64) for name, array in ARRAYS.items()}
    xyz = np.asarray(cloud.normal.points, np.float64)[0, : module.POINTS]
    rgb = np.asarray(cloud.normal.colors, np.float64)[0, : module.POINTS]
    x = np.concatenate([xyz - xyz.max(axis=0) / 2, rgb - 0.5], axis=1)
    for k in range(3):
        x = np.maximum(x @ arrays[f"shared/{k}/kernel"] + arrays[f"shared/{k}/bias"], 0)
    assert x.shape[1] == 384
    x = np.maximum(x.max(axis=0) @ arrays["hidden/kernel"] + arrays["hidden/bias"], 0)
    logits = x @ arrays["head/kernel"] + arrays["head/bias"]
    expected = np.exp(logits) / np.exp(logits).sum()
    np.testing.assert_allclose(pointnet()(cloud)[0], expected, atol=1e-5)
    with pytest.raises(ValueError, match="head/bias"):
        pointnet(6)


def test_cloud_gives_the_same_alone_and_in_a_batch() -> None:
    sizes = (module.POINTS - 1, module.POINTS + 1, 900, 1, 0)
    both = inputs(sizes)
    probabilities = pointnet()(both)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    for row, size in enumerate(sizes):
        cloud = np.asarray(both.normal.points)[row, :size], np.asarray(both.normal.colors)[row, :size]
        one = BaselineInputs(thor2.PointClouds.pack([cloud]), None, None)
        np.testing.assert_allclose(pointnet()(one)[0], probabilities[row], atol=1e-6)


CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=3, image_size=4)


def test_camera_types_match_the_published_lists() -> None:
    """Compare all cameras of the published training, in steps of 5 degrees."""
    lying = set(range(40, 145, 5))
    front = set(range(0, 55, 5)) | set(range(130, 235, 5)) | set(range(310, 360, 5))
    side = set(range(40, 145, 5)) | set(range(220, 325, 5))
    top = set(range(0, 55, 5)) | set(range(130, 185, 5))
    for azimuth, polar in itertools.product(range(0, 360, 5), range(0, 185, 5)):
        expected = (azimuth in front and polar in lying, azimuth in side and polar in lying, polar in top)
        assert module.camera_types(azimuth, polar) == tuple(np.array(module.VIEW_TYPES)[list(expected)])


def test_view_types_by_face_areas() -> None:
    for types, areas in (
        (("front",), [(1, 1, 1), (0.8, 1, 1), (1, 0.5, 0.5)]),
        (("front", "side"), [(1, 1, 0.5), (1, 0.5, 1), (1, 0.7, 0.3), (0.7, 0.3, 1)]),
        (("side", "top"), [(0.5, 0.5, 1), (0.5, 1, 0.5), (0.3, 0.7, 1)]),
        (("top",), [(0.79, 1, 1)]),
    ):
        assert {module.view_types(*each) for each in areas} == {types}


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
    pairs = enumerate(itertools.product(module.VIEW_TYPES, (1, 2, 3)))
    models = {(name, k): random_classifier(16 * k, 4, seed) for seed, (name, k) in pairs}
    arrays = {path: a for (name, k), each in models.items() for path, a in model_arrays(each, f"{name}-{k}/").items()}
    selected = [("front side", 3), ("side top", 3), ("front side", 2), ("front side", 3), ("front", 3)]
    run = SimpleNamespace(config=CONFIG, classes=("",) * 4)
    probabilities = module.load_thor(arrays, run)(inputs)
    assert probabilities.shape == (6, 4) and np.isfinite(probabilities).all()
    apply = nnx.jit(lambda model, tops: nnx.softmax(model(tops)))
    for row, (names, k) in enumerate(selected):
        tops = inputs.tops[row : row + 1, : 16 * k]
        rows = [np.asarray(apply(models[name, k], tops))[0] for name in names.split()]
        np.testing.assert_allclose(probabilities[row], max(rows, key=np.max), atol=1e-6)
    del arrays["side-2/head/bias"]
    with pytest.raises(ValueError, match="head/bias"):
        module.load_thor(arrays, run)
