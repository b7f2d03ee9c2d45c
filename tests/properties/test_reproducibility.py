"""Equal clouds give equal bytes on one machine; other batch sizes and buckets give equal values up to rounding."""

import pytest
from hypothesis import given
from processes import finish_programs, start_program

import thor2_jax as thor2
from thor2_jax import testing as laws

from .conftest import NETWORK, batches

CONFIG = thor2.DescriptorConfig()


@pytest.mark.slow
@given(aligned=batches(laws.aligned_clouds(CONFIG)), clouds=batches(laws.decided_clouds(CONFIG)))
def test_batch_sizes(aligned: thor2.PointClouds, clouds: thor2.PointClouds) -> None:
    laws.assert_batch_size_invariant(lambda c: thor2.describe_aligned(c, NETWORK, CONFIG), aligned, CONFIG)
    drift = laws.alignment_drift(clouds, CONFIG)
    laws.assert_batch_size_invariant(lambda c: thor2.describe(c, NETWORK, CONFIG), clouds, CONFIG, drift)


PROGRAM = """
import hashlib
import numpy as np
from small_clouds import brick_and_stick
import colornet, thor2_jax as thor2

packed = thor2.PointClouds.pack([cloud for views in brick_and_stick(8).values() for cloud in views])
hasher = hashlib.sha256()
for homology in ("gudhi", "closed_form"):
    descriptors = thor2.describe(packed, colornet.load_default(), thor2.DescriptorConfig(homology=homology))
    hasher.update(np.asarray(descriptors.tops2).tobytes())
print(hasher.hexdigest())
"""


@pytest.mark.slow
def test_two_processes_give_equal_descriptors() -> None:
    """tests/training/test_train_parallel.py compares the weights of trainings."""
    first, second = finish_programs(start_program(PROGRAM), start_program(PROGRAM))
    assert first == second and len(first.strip()) == 64
