"""Properties of the clouds of a frame."""

from hypothesis import given

from thor2_jax import testing as laws
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.prepared_instance import instance_clouds


@given(frame=laws.frames(), seed=laws.seeds())
def test_label_numbers_are_names(frame: RGBDFrame, seed: int) -> None:
    laws.assert_labels_are_names(instance_clouds, frame, seed)


@given(frame=laws.frames())
def test_units_of_depth(frame: RGBDFrame) -> None:
    laws.assert_depth_units_agree(instance_clouds, frame)
