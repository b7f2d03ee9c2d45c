"""Changes of the input that must not change descriptors and clouds of a frame.

Laws of descriptors hold over both backends, plainly, under jit and vmap, in two buckets.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from image_files import instance_clouds

import thor2_jax as thor2
from thor2_jax import testing as laws
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance, prepare_instance

from .conftest import NETWORK

CONFIG = thor2.DescriptorConfig()


@given(data=st.data(), seed=laws.seeds())
def test_order_padding_and_duplicates(pipeline: Any, data: st.DataObject, seed: int) -> None:
    aligned = pipeline.draw(data, laws.aligned_clouds(CONFIG, max_points=256))
    clouds = pipeline.draw(data, laws.decided_clouds(CONFIG, max_points=256))
    for describe, batch, drift in (
        (pipeline.describe_aligned, aligned, None),
        (pipeline.describe, clouds, laws.alignment_drift(clouds, CONFIG)),
    ):
        laws.assert_permutation_invariant(describe, batch, seed, CONFIG, drift)
        laws.assert_padding_invariant(describe, batch, 2 * pipeline.capacity, CONFIG, drift or 0.0)
        laws.assert_duplicates_count_twice(describe, batch, CONFIG, drift)


@given(data=st.data(), seed=laws.seeds())
def test_company_and_colours_of_the_same_regions(pipeline: Any, data: st.DataObject, seed: int) -> None:
    clouds, others = (pipeline.draw(data, laws.camera_clouds()) for _ in range(2))
    laws.assert_company_invariant(pipeline.describe, clouds, others)
    laws.assert_same_regions_alike(pipeline.describe, clouds, NETWORK, seed)
    aligned = (pipeline.draw(data, laws.aligned_clouds(CONFIG, reach=1.5)) for _ in range(2))
    laws.assert_company_invariant(pipeline.describe_aligned, *aligned)


@given(data=st.data(), steps=st.tuples(*[st.integers(-2048, 2048)] * 3))
def test_translation(pipeline: Any, data: st.DataObject, steps: tuple[int, int, int]) -> None:
    clouds = pipeline.draw(data, laws.lattice_clouds())
    laws.assert_translation_invariant(pipeline.describe, clouds, np.array(steps) / 2048)


@given(data=st.data(), rotation=laws.rotations(), shift=st.tuples(*[st.floats(-1, 1)] * 3))
def test_rigid_motion(pipeline: Any, data: st.DataObject, rotation: np.ndarray, shift: tuple[float, ...]) -> None:
    clouds = pipeline.draw(data, laws.decided_clouds(CONFIG))
    away = dataclasses.replace(clouds, points=jnp.asarray(np.asarray(clouds.points) @ rotation.T + shift, jnp.float32))
    drift = max(laws.alignment_drift(placed, CONFIG) for placed in (clouds, away))
    laws.assert_rigid_motion_invariant(pipeline.describe, clouds, rotation, shift, CONFIG, drift)


@given(data=st.data(), exponent=st.integers(-4, 4), sigma_s=st.floats(0.5, 5, width=32))
def test_metric_scale(pipeline: Any, data: st.DataObject, exponent: int, sigma_s: float) -> None:
    parameters = thor2.Parameters.of(NETWORK, CONFIG)

    def describe_at(clouds: thor2.PointClouds, sigma_s: float) -> thor2.Descriptors:
        return pipeline.describe(clouds, dataclasses.replace(parameters, sigma_s=jnp.float32(sigma_s)))

    clouds = pipeline.draw(data, laws.camera_clouds())
    laws.assert_scale_invariant(describe_at, clouds, sigma_s, exponent)


@given(data=st.data(), m=st.integers(0, 7))
def test_object_unity(pipeline: Any, data: st.DataObject, m: int) -> None:
    aligned = pipeline.draw(data, laws.aligned_clouds(CONFIG, reach=1.3))
    laws.assert_object_unity(pipeline.describe_aligned, aligned, CONFIG, m)


def test_laws_take_clouds_on_the_host_and_their_rim() -> None:
    config = thor2.DescriptorConfig(homology="closed_form")
    xyz, rgb = np.random.default_rng(0).random((2, 100, 3), np.float32) * 0.5
    clouds, others = (
        thor2.PointClouds.pack([(xyz[::step], rgb[::step])], 512, rim=[rgb[::step, 0] > 0.2], on_host=True)
        for step in (1, 2)
    )

    def describe(clouds: thor2.PointClouds) -> thor2.Descriptors:
        """Return the descriptors of the points that are not in the rim."""
        mask = np.asarray(clouds.mask) & ~np.asarray(clouds.rim)
        return thor2.describe_aligned(dataclasses.replace(clouds, mask=mask), NETWORK, config)

    laws.assert_permutation_invariant(describe, clouds, 0, config)
    laws.assert_padding_invariant(describe, clouds, 1024, config)
    laws.assert_duplicates_count_twice(describe, clouds, config)
    laws.assert_batch_size_invariant(describe, clouds, config)
    laws.assert_company_invariant(describe, clouds, others)


def prepared_instances(frame: RGBDFrame) -> list[PreparedInstance]:
    return [prepare_instance(frame, label, CONFIG.sigma_s) for label in frame.instances]


@given(frame=laws.frames(), seed=laws.seeds(), factor=st.sampled_from([1, 300]))
def test_label_numbers_are_names(frame: RGBDFrame, seed: int, factor: int) -> None:
    labels = frame.label_image.astype(np.int32) * factor
    for clouds_of in (instance_clouds, prepared_instances):
        laws.assert_labels_are_names(clouds_of, dataclasses.replace(frame, labels=labels), seed)


@given(frame=laws.frames())
def test_units_of_depth(frame: RGBDFrame) -> None:
    for clouds_of in (instance_clouds, prepared_instances):
        laws.assert_depth_units_agree(clouds_of, frame)


def test_laws_of_frames_compare_occlusion() -> None:
    labels, depth = np.zeros((60, 60), np.int32), np.full((60, 60), 700, np.uint16)
    labels[10:50, 10:30], labels[10:50, 30:50], depth[:, 30:] = 1, 2, 600
    frame = RGBDFrame(np.zeros((60, 60, 3), np.uint8), depth, labels, thor2.Intrinsics(100.0, 100.0, 30.0, 30.0))
    assert [each.occluded for each in prepared_instances(frame)] == [True, False]

    def by_numbers(frame: RGBDFrame) -> list[PreparedInstance]:
        return [dataclasses.replace(each, occluded=each.label == 2) for each in prepared_instances(frame)]

    with pytest.raises(AssertionError, match="occluded"):
        laws.assert_labels_are_names(by_numbers, frame, 0)
