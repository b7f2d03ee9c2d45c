"""One batch in two processes with several devices against one device."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import Mesh
from processes import finish_programs, free_port, start_program
from refusals import assert_refused
from small_clouds import NETWORK, aligned_cloud, random_clouds
from small_runs import SMALL_CONFIG

import thor2_jax as thor2
from thor2_jax.descriptor import describe
from thor2_jax.descriptor.describe import batch_mesh, describe_sharded, shard_clouds

PROGRAM = """
import sys
import jax
import numpy as np
from small_clouds import random_clouds
import colornet
import thor2_jax as thor2
from thor2_jax.descriptor.describe import batch_mesh, describe_sharded, shard_clouds

port, rank, homology, folder = sys.argv[1], int(sys.argv[2]), *sys.argv[3:]
jax.distributed.initialize(f"localhost:{port}", 2, rank)
clouds = thor2.PointClouds.pack(random_clouds(rank, range(100, 260, 20)), 512)
config = thor2.DescriptorConfig(homology=homology)
descriptors = describe_sharded(shard_clouds(clouds, batch_mesh()), colornet.load_default(), config)
assert descriptors.images.shape[0] == 16 and len(descriptors.images.sharding.device_set) == 8
for name in ("tops2", "overflow"):
    shards = getattr(descriptors, name).addressable_shards
    np.save(f"{folder}/{name}{rank}.npy", np.concatenate([np.asarray(shard.data) for shard in shards]))
"""


def test_each_device_describes_its_clouds(monkeypatch: pytest.MonkeyPatch) -> None:
    """With a function that compiles at once in place of `describe`, and one device."""
    monkeypatch.setattr(describe, "describe", lambda clouds, network, config: (clouds.points * config.alpha, clouds))
    config = dataclasses.replace(SMALL_CONFIG, alpha=0.3)  # of no other test
    packed = thor2.PointClouds.pack([aligned_cloud(k, 100) for k in range(3)])
    turned, clouds = describe_sharded(shard_clouds(packed, batch_mesh()), NETWORK, config)
    np.testing.assert_allclose(turned, packed.points * config.alpha)
    jax.tree.map(np.testing.assert_array_equal, clouds, packed)
    assert_refused("shard_clouds", describe_sharded, packed, NETWORK, config)
    assert_refused("multiple of 2", shard_clouds, packed, Mesh(np.array(jax.devices() * 2), ("batch",)))


@pytest.mark.slow
@pytest.mark.parametrize("homology", ["gudhi", "closed_form"])
def test_two_processes_with_four_devices_equal_one_device(homology: str, tmp_path: Path) -> None:
    port = free_port()
    finish_programs(*(start_program(PROGRAM, port, rank, homology, tmp_path, devices=4) for rank in range(2)))
    clouds = thor2.PointClouds.pack([cloud for rank in range(2) for cloud in random_clouds(rank, range(100, 260, 20))])
    expected = thor2.describe(clouds, NETWORK, thor2.DescriptorConfig(homology=homology))
    for name in ("tops2", "overflow"):
        sharded = np.concatenate([np.load(tmp_path / f"{name}{rank}.npy") for rank in range(2)])
        np.testing.assert_allclose(sharded, getattr(expected, name), atol=1e-6)
