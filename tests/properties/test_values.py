"""Values of descriptors: masses, linearity, stability, the equations, and the limit of the relaxation."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import colornet
import thor2_jax as thor2
from thor2_jax import testing as laws

from .conftest import NETWORK, batches

CONFIG = thor2.DescriptorConfig(homology="closed_form")
ALIGNED = batches(laws.aligned_clouds(CONFIG))


@pytest.mark.slow
@given(clouds=batches(laws.camera_clouds()), aligned=batches(laws.aligned_clouds(CONFIG, reach=1.5)))
def test_gudhi_is_the_closed_form(clouds: thor2.PointClouds, aligned: thor2.PointClouds) -> None:
    for function, batch in ((thor2.describe, clouds), (thor2.describe_aligned, aligned)):
        for config in (CONFIG, thor2.DescriptorConfig.released(homology="closed_form")):
            both = [dataclasses.replace(config, homology=name) for name in ("closed_form", "gudhi")]
            first, second = (lambda clouds, c=c, f=function: f(clouds, NETWORK, c) for c in both)
            laws.assert_backends_agree(first, second, batch)


@given(data=st.data(), reach=st.sampled_from([1.0, 1.6]))
def test_equations(pipeline: Any, data: st.DataObject, reach: float) -> None:
    """Both conventions follow the equations, and overflow is the same count."""
    aligned = pipeline.draw(data, laws.aligned_clouds(CONFIG, reach=reach))
    for config in (pipeline.config, dataclasses.replace(pipeline.config, convention="released")):
        ways = dataclasses.replace(pipeline, config=config)
        laws.assert_follows_equations(ways.describe_aligned, aligned, NETWORK, config)
    images = pipeline.describe_aligned(aligned).images
    laws.assert_image_mass(images, thor2.diagrams(aligned, pipeline.config), CONFIG)


@given(data=st.data(), seed=laws.seeds(), factors=st.tuples(*[st.integers(-8, 8).map(lambda k: k / 4)] * 2))
def test_embedding_is_linear(pipeline: Any, data: st.DataObject, seed: int, factors: tuple[float, float]) -> None:
    parameters = thor2.Parameters.of(NETWORK, CONFIG)

    def describe_with(clouds: thor2.PointClouds, similarity: np.ndarray) -> thor2.Descriptors:
        return pipeline.describe_aligned(clouds, dataclasses.replace(parameters, similarity=jnp.asarray(similarity)))

    first, second = (pipeline.draw(data, laws.aligned_clouds(CONFIG, max_points=256)) for _ in range(2))
    laws.assert_embedding_additive(pipeline.describe_aligned, first, second)
    pair = tuple(np.random.default_rng(seed).normal(size=(2, 22, 22)).astype(np.float32))
    laws.assert_embedding_linear(describe_with, first, pair, factors)


@given(aligned=ALIGNED, network=laws.networks(), seed=laws.seeds())
def test_strips_and_other_networks(aligned: thor2.PointClouds, network: colornet.ColorNetwork, seed: int) -> None:
    def describe(clouds: thor2.PointClouds) -> thor2.Descriptors:
        return thor2.describe_aligned(clouds, network, CONFIG)

    laws.assert_same_regions_alike(describe, aligned, network, seed)
    laws.assert_follows_equations(describe, aligned, network, CONFIG)
    laws.assert_color_mass(thor2.strips(aligned, network, CONFIG), aligned)
    for axis in "xyz":
        laws.assert_mirrored_strips(lambda clouds: thor2.strips(clouds, NETWORK, CONFIG), aligned, CONFIG, axis)


@given(aligned=ALIGNED, exponent=st.integers(1, 37), seed=laws.seeds())
def test_overflow_is_never_silent(aligned: thor2.PointClouds, exponent: int, seed: int) -> None:
    """Some points lie up to 10^37 from the origin, close to the limit of float32."""
    rng = np.random.default_rng(seed)
    points = np.asarray(aligned.points, np.float64)
    stray = rng.random(points.shape[:2]) < 0.05
    signs, sizes = rng.choice([-1, 1], (stray.sum(), 3)), rng.uniform(1, 9.9, (stray.sum(), 3))
    points[stray] = signs * sizes * 10.0**exponent
    clouds = dataclasses.replace(aligned, points=jnp.asarray(points * np.asarray(aligned.mask)[..., None], jnp.float32))
    laws.assert_overflow_told(lambda clouds: thor2.describe_aligned(clouds, NETWORK, CONFIG), clouds, NETWORK, CONFIG)
    laws.assert_color_mass(thor2.strips(clouds, NETWORK, CONFIG), clouds)


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


AT_LEAST_15 = settings(max_examples=max(15, settings().max_examples))


def test_an_occluded_end_flips_the_cloud() -> None:
    seen: set[int] = set()

    @AT_LEAST_15
    @given(clouds=batches(laws.camera_clouds()), seed=laws.seeds())
    def law(clouds: thor2.PointClouds, seed: int) -> None:
        flipped = laws.assert_flip_follows_rule(lambda clouds: thor2.view_normalize(clouds, CONFIG), clouds, seed)
        seen.update(flipped.tolist())

    law()
    assert {0, 1} <= seen


@given(data=st.data(), seed=laws.seeds(), eps=st.floats(1e-4, 0.0025))
def test_stability(pipeline: Any, data: st.DataObject, seed: int, eps: float) -> None:
    aligned = pipeline.draw(data, laws.aligned_clouds(CONFIG))
    moved = laws.moved_within_strips(aligned, CONFIG, seed, eps)
    share = laws.assert_stable(
        pipeline.describe_aligned, lambda c: thor2.diagrams(c, pipeline.config), aligned, moved, eps, CONFIG
    )
    assert share <= 1 / math.sqrt(5) + 0.01


@pytest.mark.slow
@given(aligned=batches(laws.aligned_clouds(CONFIG, max_points=256, margin=0.2)), factor=st.sampled_from([0.02, 0.01]))
def test_the_relaxation_converges_to_the_hard_descriptor(aligned: thor2.PointClouds, factor: float) -> None:
    laws.assert_relaxation_converges(
        lambda clouds, config: thor2.describe_aligned(clouds, NETWORK, config), aligned, NETWORK, CONFIG, factor
    )
