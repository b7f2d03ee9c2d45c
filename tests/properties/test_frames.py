"""Properties of the clouds of a frame."""

import dataclasses

import numpy as np
from hypothesis import given

from thor2_jax import testing as laws
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.instance_clouds import PreparedInstance, instance_clouds


def assert_equal_clouds(first: PreparedInstance, second: PreparedInstance) -> None:
    for name in ("kept_by_fallback", "reason", "points", "colors"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


@given(frame=laws.frames(), seed=laws.seeds())
def test_label_numbers_are_names(frame: RGBDFrame, seed: int) -> None:
    other = np.concatenate([[0], np.random.default_rng(seed).permutation(np.arange(1, 256))]).astype(np.uint16)
    clouds = {c.label: c for c in instance_clouds(dataclasses.replace(frame, labels=other[frame.label_image]))}
    for cloud in instance_clouds(frame):
        assert_equal_clouds(cloud, clouds.pop(int(other[cloud.label])))
    assert not clouds


@given(frame=laws.frames())
def test_units_of_depth(frame: RGBDFrame) -> None:
    in_metres = instance_clouds(dataclasses.replace(frame, depth=frame.depth_m))
    for first, second in zip(instance_clouds(frame), in_metres, strict=True):
        assert_equal_clouds(first, second)
