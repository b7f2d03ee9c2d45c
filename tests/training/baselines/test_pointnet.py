"""The PointNet baseline against a NumPy reference."""

import numpy as np
import pytest
from flax import nnx
from helpers import random_clouds

import thor2_jax as thor2
from training.baselines.baseline import BaselineInputs
from training.baselines.pointnet import POINTS, ColoredPointNet, PointNet


def model() -> ColoredPointNet:
    return ColoredPointNet(PointNet(5, rngs=nnx.Rngs(3)))


def inputs(sizes: tuple[int, ...], seed: int = 0) -> BaselineInputs:
    return BaselineInputs(thor2.PointClouds.pack(random_clouds(seed, sizes)), np.zeros((len(sizes), 1), np.float32))


def test_probabilities_match_numpy() -> None:
    """The cloud has as many points as are sampled, so all of them are used."""
    cloud, net = inputs((POINTS,)), model()
    arrays = {name: array.astype(np.float64) for name, array in net.arrays().items()}
    xyz = np.asarray(cloud.normal.points, np.float64)[0, :POINTS]
    rgb = np.asarray(cloud.normal.colors, np.float64)[0, :POINTS]
    x = np.concatenate([xyz - xyz.max(axis=0) / 2, rgb - 0.5], axis=1)
    for k in range(3):
        x = np.maximum(x @ arrays[f"shared/{k}/kernel"] + arrays[f"shared/{k}/bias"], 0)
    assert x.shape[1] == 384
    x = np.maximum(x.max(axis=0) @ arrays["hidden/kernel"] + arrays["hidden/bias"], 0)
    logits = x @ arrays["head/kernel"] + arrays["head/bias"]
    expected = np.exp(logits) / np.exp(logits).sum()
    np.testing.assert_allclose(net.probabilities(cloud)[0], expected, atol=1e-5)


@pytest.mark.parametrize("sizes", [(1,), (0, 7), (POINTS - 1, POINTS + 1, 900)])
def test_any_number_of_points(sizes: tuple[int, ...]) -> None:
    probabilities = model().probabilities(inputs(sizes))
    assert probabilities.shape == (len(sizes), 5)
    np.testing.assert_allclose(probabilities.sum(axis=1), 1, atol=1e-5)


def test_cloud_gives_the_same_alone_and_in_a_batch() -> None:
    net, both = model(), inputs((800, 500))
    one = BaselineInputs(
        thor2.PointClouds.pack([(np.asarray(both.normal.points)[0, :800], np.asarray(both.normal.colors)[0, :800])]),
        both.tops[:1],
    )
    np.testing.assert_allclose(net.probabilities(one)[0], net.probabilities(both)[0], atol=1e-6)


def test_network_round_trips_through_arrays() -> None:
    net, cloud = model(), inputs((500,))
    again = ColoredPointNet.with_arrays(net.arrays(), 5)
    np.testing.assert_array_equal(again.probabilities(cloud), net.probabilities(cloud))
    with pytest.raises(ValueError, match="head/bias"):
        ColoredPointNet.with_arrays(net.arrays(), 6)
