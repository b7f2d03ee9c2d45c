"""Equal seeds give equal bytes on one machine; other batch sizes and buckets give equal values up to rounding."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given

import colornet
import thor2_jax as thor2
from thor2_jax import testing as laws

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig()


@pytest.mark.slow
@given(
    aligned=laws.packed(laws.aligned_clouds(CONFIG), 4, 512), clouds=laws.packed(laws.decided_clouds(CONFIG), 4, 512)
)
def test_batch_sizes(aligned: thor2.PointClouds, clouds: thor2.PointClouds) -> None:
    laws.assert_batch_size_invariant(lambda c: thor2.describe_aligned(c, NETWORK, CONFIG), aligned, CONFIG)
    drift = laws.alignment_drift(clouds, CONFIG)
    laws.assert_batch_size_invariant(lambda c: thor2.describe(c, NETWORK, CONFIG), clouds, CONFIG, drift)


PROGRAM = """
import hashlib, sys, tempfile
from pathlib import Path
import numpy as np
from flax import nnx
import colornet, thor2_jax as thor2
from training.fitting.options import FitOptions
from training.fitting.job import RunSettings, train_run
from training.views.normalized_views import MemoryViews

rng = np.random.default_rng(0)
clouds = {"a": [], "b": []}
for k in range(8):
    points = rng.random((300, 3)) * (0.1 + 0.1 * (k % 2)) + [0, 0, 0.5]
    clouds["ab"[k % 2]].append((points.astype(np.float32), rng.integers(0, 256, (300, 3), np.uint8)))
packed = thor2.PointClouds.pack([cloud for views in clouds.values() for cloud in views])
hasher = hashlib.sha256()
for homology in ("gudhi", "closed_form"):

    descriptors = thor2.describe(packed, colornet.load_default(), thor2.DescriptorConfig(homology=homology))
    hasher.update(np.asarray(descriptors.tops2).tobytes())
config = thor2.DescriptorConfig(homology="closed_form", n_slices=3, n_strips=8, image_size=8)
with tempfile.TemporaryDirectory() as folder:
    options = FitOptions(2, batch_size=4, seed=5)
    (run,) = train_run(MemoryViews(clouds, config), Path(folder) / "run", RunSettings(("tops2",), options, config))
for path, leaf in sorted(nnx.to_flat_state(nnx.state(run.classifiers["tops2"])), key=lambda pair: str(pair[0])):
    hasher.update(str(path).encode() + np.asarray(leaf[...]).tobytes())
print(hasher.hexdigest())
"""


@pytest.mark.slow
def test_two_processes_give_equal_descriptors_and_weights() -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    digests = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    ]
    assert digests[0] == digests[1] and len(digests[0].strip()) == 64
