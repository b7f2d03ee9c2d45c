"""One batch over several devices, of one process or of many (jax.distributed): every device describes its own clouds.

>>> mesh = batch_mesh()                                             # doctest: +SKIP   all devices of all processes
>>> clouds = shard_clouds(PointClouds.pack(mine), mesh)             # doctest: +SKIP   this process's part of the batch
>>> found = describe_sharded(clouds, network, config)               # doctest: +SKIP   sharded like the clouds
"""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["batch_mesh", "describe_sharded", "shard_clouds"]

AXIS = "batch"


def batch_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """A mesh of devices (by default all of all processes) along the one axis "batch"."""
    return Mesh(np.asarray(jax.devices() if devices is None else devices), (AXIS,))


def shard_clouds(clouds: PointClouds, mesh: Mesh) -> PointClouds:
    """Distribute a batch over the devices of `mesh`.

    Args:
        clouds: [B, N]; with several processes, this process's part of the batch: B and N must be the same in all.
        mesh: from `batch_mesh`.

    Returns:
        The whole batch [B * processes, N], sharded along B.

    Raises:
        InputError: B is no multiple of the number of this process's devices.
    """
    local = len(mesh.local_devices)
    if clouds.mask.shape[0] % local:
        raise InputError(f"clouds has {clouds.mask.shape[0]} clouds; expected a multiple of the {local} devices")
    sharding = NamedSharding(mesh, PartitionSpec(AXIS))
    return jax.tree.map(lambda a: jax.make_array_from_process_local_data(sharding, np.asarray(a)), clouds)


@functools.lru_cache(maxsize=8)
def _sharded(network: ColorNetwork, config: DescriptorConfig, mesh: Mesh) -> Any:
    spec = PartitionSpec(AXIS)

    def local(clouds: PointClouds) -> Descriptors:
        return describe(clouds, network, config)

    return jax.jit(jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))


def describe_sharded(clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> Descriptors:
    """`describe` with every device at work on its own clouds; nothing travels between devices.

    Args:
        clouds: as `shard_clouds` returns them.
        network: the colour network.
        config: the descriptor. Static.

    Returns:
        Descriptors sharded like the clouds; a process reads its own part by `addressable_shards`.

    Raises:
        InputError: `clouds` is not sharded by `shard_clouds`.
    """
    sharding = getattr(clouds.points, "sharding", None)
    if not isinstance(sharding, NamedSharding) or sharding.mesh.axis_names != (AXIS,):
        raise InputError(f"clouds has the sharding {sharding}; expected clouds from shard_clouds")
    return _sharded(network, config, sharding.mesh)(clouds)
