"""Values of descriptors: the equations, other networks and overflow."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import colornet
import thor2_jax as thor2
from thor2_jax import testing as laws

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(homology="closed_form")
SIZE = 4


def aligned_batches(reach: float = 1.0) -> Any:
    return laws.packed(laws.aligned_clouds(CONFIG, reach=reach), SIZE, 512)


@pytest.mark.slow
@given(clouds=laws.packed(laws.camera_clouds(), SIZE, 512), aligned=aligned_batches(reach=1.5))
def test_gudhi_is_the_closed_form(clouds: thor2.PointClouds, aligned: thor2.PointClouds) -> None:
    for function, batch in ((thor2.describe, clouds), (thor2.describe_aligned, aligned)):
        for config in (CONFIG, thor2.DescriptorConfig.released(homology="closed_form")):
            first, second = (dataclasses.replace(config, homology=name) for name in ("closed_form", "gudhi"))
            laws.assert_equal(function(batch, NETWORK, second), function(batch, NETWORK, first))


@given(data=st.data(), reach=st.sampled_from([1.0, 1.6]))
def test_equations(pipeline: Any, data: st.DataObject, reach: float) -> None:
    """Both conventions follow the equations, and overflow is the same count."""
    aligned = data.draw(laws.packed(laws.aligned_clouds(CONFIG, reach=reach), SIZE, pipeline.capacity))
    for config in (pipeline.config, dataclasses.replace(pipeline.config, convention="released")):
        ways = dataclasses.replace(pipeline, config=config)
        laws.assert_follows_equations(ways.describe_aligned, aligned, NETWORK, config)


@given(aligned=aligned_batches(), network=laws.networks(), seed=laws.seeds())
def test_other_networks(aligned: thor2.PointClouds, network: colornet.ColorNetwork, seed: int) -> None:
    def describe(clouds: thor2.PointClouds) -> thor2.Descriptors:
        return thor2.describe_aligned(clouds, network, CONFIG)

    laws.assert_same_regions_alike(describe, aligned, network, seed)
    laws.assert_follows_equations(describe, aligned, network, CONFIG)


@given(aligned=aligned_batches(), exponent=st.integers(1, 37), seed=laws.seeds())
def test_overflow_is_never_silent(aligned: thor2.PointClouds, exponent: int, seed: int) -> None:
    """Some points lie up to 10^37 from the origin, close to the limit of float32."""
    rng = np.random.default_rng(seed)
    points = np.asarray(aligned.points, np.float64)
    stray = rng.random(points.shape[:2]) < 0.05
    signs, sizes = rng.choice([-1, 1], (stray.sum(), 3)), rng.uniform(1, 9.9, (stray.sum(), 3))
    points[stray] = signs * sizes * 10.0**exponent
    clouds = dataclasses.replace(aligned, points=jnp.asarray(points * np.asarray(aligned.mask)[..., None], jnp.float32))
    describe = lambda clouds: thor2.describe_aligned(clouds, NETWORK, CONFIG)  # noqa: E731
    laws.assert_follows_equations(describe, clouds, NETWORK, CONFIG)


@pytest.mark.parametrize("far", [1e7, 1e8, 1e37])
def test_points_too_far_to_be_sliced_are_counted_in_overflow(far: float) -> None:
    """The distance in hundredths does not fit into 32 bits, and squared distances overflow float32."""
    points = np.array([[0.1, 0.1, 0.15], [far, 0.1, 0.15], [-far, 0.1, 0.15], [0.1, 0.2, far]])
    clouds = thor2.PointClouds.pack([(points, np.zeros((4, 3)))], 512)
    whole = np.random.default_rng(0).random((40, 3)) * far * 1e13 if far < 1e20 else np.full((40, 3), far)
    for config in (CONFIG, thor2.DescriptorConfig.released(homology="closed_form")):
        descriptors = thor2.describe_aligned(clouds, NETWORK, config)
        assert int(descriptors.overflow[0]) == 3 and np.isfinite(np.asarray(descriptors.tops2)).all()
        moved = thor2.describe(thor2.PointClouds.pack([(whole, np.zeros((40, 3)))], 512), NETWORK, config)
        assert int(moved.overflow[0]) == 40 and not np.asarray(moved.tops2).any()
