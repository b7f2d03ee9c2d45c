"""Describe one batch on several devices, of one process or of several (jax.distributed).

>>> mesh = batch_mesh()                                             # doctest: +SKIP   # all devices of all processes
>>> clouds = shard_clouds(PointClouds.pack(local), mesh)            # doctest: +SKIP   # the clouds of this process
>>> descriptors = describe_sharded(clouds, network, config)         # doctest: +SKIP   # sharded like the clouds
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

BATCH_AXIS = "batch"
"""Name of the only axis of the device mesh."""


def batch_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Return a mesh of devices, by default all devices of all processes, along the axis "batch"."""
    return Mesh(np.asarray(jax.devices() if devices is None else devices), (BATCH_AXIS,))


def shard_clouds(clouds: PointClouds, mesh: Mesh) -> PointClouds:
    """Distribute a batch over the devices of `mesh`.

    Args:
        clouds: [B, N]. With several processes, the clouds of this process; B and N must be equal in all of them.
        mesh: as `batch_mesh` returns it.

    Returns:
        The whole batch [B * processes, N], sharded along B.

    Raises:
        InputError: B is not a multiple of the number of devices of this process.
    """
    local = len(mesh.local_devices)
    if clouds.mask.shape[0] % local:
        raise InputError(
            f"clouds has {clouds.mask.shape[0]} clouds; expected a multiple of {local}, the number of local devices"
        )
    sharding = NamedSharding(mesh, PartitionSpec(BATCH_AXIS))
    return jax.tree.map(lambda a: jax.make_array_from_process_local_data(sharding, np.asarray(a)), clouds)


@functools.partial(jax.jit, static_argnums=(1, 2, 3))
def _sharded(clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, mesh: Mesh) -> Descriptors:
    spec, local = PartitionSpec(BATCH_AXIS), functools.partial(describe, network=network, config=config)
    return jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)(clouds)


def describe_sharded(clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> Descriptors:
    """Describe a sharded batch: each device describes its own clouds, without communication between devices.

    Args:
        clouds: as `shard_clouds` returns them.
        network: the colour network.
        config: static.

    Returns:
        Descriptors sharded like the clouds; a process reads its own ones through `addressable_shards`.

    Raises:
        InputError: `clouds` does not come from `shard_clouds`.
    """
    sharding = getattr(clouds.points, "sharding", None)
    if not isinstance(sharding, NamedSharding) or sharding.mesh.axis_names != (BATCH_AXIS,):
        raise InputError(f"clouds has the sharding {sharding}; expected clouds from shard_clouds")
    return _sharded(clouds, network, config, sharding.mesh)
