"""One batch on eight devices and in two processes against one device, each in separate processes."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import Mesh
from processes import finish_programs, free_port, start_program
from refusals import assert_refused
from small_clouds import aligned_cloud
from small_runs import SMALL_CONFIG

import colornet
import thor2_jax as thor2
from thor2_jax.descriptor import describe
from thor2_jax.descriptor.describe import batch_mesh, describe_sharded, shard_clouds

_CLOUDS = """
import json, sys
import numpy as np
import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.describe import batch_mesh, describe_sharded, shard_clouds
import jax

def clouds(count):
    rng = np.random.default_rng(0)
    for k in range(count):
        n = 100 + 20 * k
        yield rng.random((n, 3)) * (0.2, 0.1, 0.05), rng.integers(0, 256, (n, 3), dtype=np.uint8)

network = colornet.load_default()
"""

_DEVICES = """
assert len(jax.devices()) == 8
packed = thor2.PointClouds.pack(list(clouds(16)), 512)
config = thor2.DescriptorConfig(homology=sys.argv[1])
one = thor2.describe(packed, network, config)
many = describe_sharded(shard_clouds(packed, batch_mesh()), network, config)
assert len(many.images.sharding.device_set) == 8
worst = max(float(abs(np.asarray(a) - np.asarray(b)).max()) for a, b in
            zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True))
print(json.dumps(worst))
"""

_PROCESS = """
port, rank, folder = sys.argv[1], int(sys.argv[2]), sys.argv[3]
jax.distributed.initialize(f"localhost:{port}", 2, rank)
clouds_of_rank = list(clouds(8))[rank * 4 : rank * 4 + 4]
config = thor2.DescriptorConfig(homology="gudhi")
descriptors = describe_sharded(shard_clouds(thor2.PointClouds.pack(clouds_of_rank, 512), batch_mesh()), network, config)
assert descriptors.images.shape[0] == 8
tops2 = [np.asarray(s.data) for s in descriptors.tops2.addressable_shards]
np.save(f"{folder}/{rank}.npy", np.concatenate(tops2))
"""

_ALONE = """
packed = thor2.PointClouds.pack(list(clouds(8)), 512)
np.save(sys.argv[1], np.asarray(thor2.describe(packed, network, thor2.DescriptorConfig(homology="gudhi")).tops2))
"""


def test_each_device_describes_its_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a function that compiles at once in place of `describe`, and one device."""
    monkeypatch.setattr(describe, "describe", lambda clouds, network, config: (clouds.points * config.alpha, clouds))
    config = dataclasses.replace(SMALL_CONFIG, alpha=0.3)  # of no other test
    network, packed = colornet.load_default(), thor2.PointClouds.pack([aligned_cloud(k, 100) for k in range(3)])
    turned, clouds = describe_sharded(shard_clouds(packed, batch_mesh()), network, config)
    np.testing.assert_allclose(turned, packed.points * config.alpha)
    jax.tree.map(np.testing.assert_array_equal, clouds, packed)
    assert_refused("shard_clouds", describe_sharded, packed, network, config)
    assert_refused("multiple of 2", shard_clouds, packed, Mesh(np.array(jax.devices() * 2), ("batch",)))


@pytest.mark.slow
@pytest.mark.parametrize("homology", ["gudhi", "closed_form"])
def test_eight_devices_equal_one(homology: str) -> None:
    (output,) = finish_programs(start_program(_CLOUDS + _DEVICES, homology, devices=8))
    assert json.loads(output.splitlines()[-1]) <= 1e-6


@pytest.mark.slow
def test_two_processes_equal_one(tmp_path: Path) -> None:
    port = free_port()
    finish_programs(*(start_program(_CLOUDS + _PROCESS, port, rank, tmp_path) for rank in range(2)))
    finish_programs(start_program(_CLOUDS + _ALONE, tmp_path / "alone.npy"))
    sharded = np.concatenate([np.load(tmp_path / f"{rank}.npy") for rank in range(2)])
    np.testing.assert_allclose(sharded, np.load(tmp_path / "alone.npy"), atol=1e-6)
