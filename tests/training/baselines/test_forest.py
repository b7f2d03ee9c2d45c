"""Features of the random forest against NumPy, and its predictions against scikit-learn."""

import numpy as np
import pytest
from helpers import random_clouds
from sklearn.ensemble import RandomForestClassifier

import colornet
import thor2_jax as thor2
from training.baselines.baseline import BaselineInputs
from training.baselines.forest import Forest, forest_features, tree_arrays

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(homology="closed_form")


def normal(sizes: tuple[int, ...]) -> thor2.PointClouds:
    clouds = [(xyz - xyz.min(axis=0) if len(xyz) else xyz, rgb) for xyz, rgb in random_clouds(1, sizes)]
    return thor2.view_normalize(thor2.PointClouds.pack(clouds, camera=[0, 0, -3]), CONFIG)


def test_features_match_numpy() -> None:
    clouds = normal((400, 1, 0, 57))
    features = forest_features(clouds, NETWORK, CONFIG)
    assert features.shape == (4, 22 + 3 + 14)
    aligned = np.asarray(thor2.turn(clouds, CONFIG).points, np.float64)
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
            inside = np.floor(z / CONFIG.sigma_1) == k
            strips = np.floor(x[inside] / CONFIG.sigma_2)
            wide = (np.ptp(strips) + 1) * CONFIG.sigma_2 if inside.any() else 0
            deep = np.ptp(y[inside]) if inside.any() else 0
            assert expected[25 + k] == pytest.approx(wide, abs=1e-6)
            assert expected[32 + k] == pytest.approx(deep, abs=1e-6)


@pytest.mark.parametrize("depth", [None, 1])
def test_predictions_match_scikit_learn(depth: int | None) -> None:
    rng = np.random.default_rng(0)
    x = rng.random((300, 5)).astype(np.float32)
    y = (x[:, 0] * 3).astype(int) + (x[:, 1] > 0.5)
    grown = RandomForestClassifier(9, min_samples_leaf=2, max_depth=depth, random_state=0).fit(x, y)
    forest = Forest(tree_arrays(grown), NETWORK, CONFIG)
    features = np.concatenate([x, rng.random((50, 5)).astype(np.float32)])
    np.testing.assert_allclose(forest.predict(features), grown.predict_proba(features), atol=1e-6)


def test_single_leaf_trees_and_missing_arrays() -> None:
    grown = RandomForestClassifier(2, random_state=0).fit(np.zeros((4, 39), np.float32), [0, 0, 0, 1])
    nodes = tree_arrays(grown)
    forest = Forest(nodes, NETWORK, CONFIG)
    inputs = BaselineInputs(normal((60, 0)), np.zeros((2, 1), np.float32))
    np.testing.assert_allclose(forest.probabilities(inputs), grown.predict_proba(np.zeros((2, 39))), atol=1e-6)
    with pytest.raises(ValueError, match="root"):
        Forest({name: nodes[name] for name in nodes if name != "root"}, NETWORK, CONFIG)
