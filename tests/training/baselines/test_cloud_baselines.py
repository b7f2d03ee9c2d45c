"""The random forest against NumPy and scikit-learn, and PointNet against a NumPy reference."""

from types import SimpleNamespace

import numpy as np
import pytest
from flax import nnx
from sklearn.ensemble import RandomForestClassifier
from small_clouds import CLOSED, NETWORK, random_clouds

import thor2_jax as thor2
from thor2_jax.networks.networks import model_arrays
from training.baselines import cloud_baselines as module
from training.baselines.baseline import BaselineInputs, Predictor
from training.baselines.cloud_baselines import POINTS, PointNet, forest_features, load_pointnet


def normal(sizes: tuple[int, ...]) -> thor2.PointClouds:
    clouds = [(xyz - xyz.min(axis=0) if len(xyz) else xyz, rgb) for xyz, rgb in random_clouds(1, sizes)]
    return thor2.view_normalize(thor2.PointClouds.pack(clouds, camera=[0, 0, -3]), CLOSED)


def test_features_match_numpy() -> None:
    clouds = normal((400, 1, 0, 57))
    features = forest_features(clouds, NETWORK, CLOSED)
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


ARRAYS = model_arrays(PointNet(5, rngs=nnx.Rngs(3)))


def pointnet(classes: int = 5) -> Predictor:
    return load_pointnet(ARRAYS, SimpleNamespace(classes=("",) * classes))  # type: ignore[arg-type]


def inputs(sizes: tuple[int, ...]) -> BaselineInputs:
    return BaselineInputs(thor2.PointClouds.pack(random_clouds(0, sizes)), None, None)


def test_probabilities_match_numpy() -> None:
    """The cloud has as many points as are sampled, so all of them are used."""
    cloud = inputs((POINTS,))
    arrays = {name: array.astype(np.float64) for name, array in ARRAYS.items()}
    xyz = np.asarray(cloud.normal.points, np.float64)[0, :POINTS]
    rgb = np.asarray(cloud.normal.colors, np.float64)[0, :POINTS]
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
    sizes = (POINTS - 1, POINTS + 1, 900, 1, 0)
    both = inputs(sizes)
    probabilities = pointnet()(both)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)
    for row, size in enumerate(sizes):
        cloud = np.asarray(both.normal.points)[row, :size], np.asarray(both.normal.colors)[row, :size]
        one = BaselineInputs(thor2.PointClouds.pack([cloud]), None, None)
        np.testing.assert_allclose(pointnet()(one)[0], probabilities[row], atol=1e-6)
