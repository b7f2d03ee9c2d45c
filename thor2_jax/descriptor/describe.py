"""The complete pipeline from point clouds to TOPS and TOPS2 (paper, sections "TOPS" and "TOPS2").

>>> import colornet, thor2_jax as thor2
>>> network, config = colornet.load_default(), thor2.DescriptorConfig(homology="closed_form")
>>> clouds = thor2.PointClouds.pack([(np.random.rand(1000, 3) / 10, np.random.rand(1000, 3))])
>>> thor2.describe(clouds, network, config).tops2.shape
(1, 11942)

On CPUs, large batches are computed in chunks of clouds, so that intermediate tables stay in the caches:
`map_chunks(function, clouds)` equals `function(clouds)` for any function that treats each cloud separately.
`map_large_chunks` does the same outside `jax.jit`, with larger chunks. On accelerators, both simply call the function.
`describe_stream` describes more clouds than fit into memory, and `describe_sharded` a batch on several devices:

>>> mesh = batch_mesh()  # all devices of all processes             # doctest: +SKIP
>>> clouds = shard_clouds(PointClouds.pack(local), mesh)  # the clouds of this process   # doctest: +SKIP
>>> descriptors = describe_sharded(clouds, network, config)  # sharded like the clouds   # doctest: +SKIP
"""

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import colornet
from colornet import ColorNetwork
from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.persistence import count_past_window, diagrams_of_strips, persistence_images
from thor2_jax.descriptor.slicing import RegionSets, color_sets, region_sets, strips_of_cloud
from thor2_jax.descriptor.view_normalization import align
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors, Diagrams, Parameters, PointClouds, Strips, check_batch, check_types, matmul

__all__ = [
    "BATCH_AXIS",
    "batch_mesh",
    "chunk_size",
    "describe",
    "describe_aligned",
    "describe_sharded",
    "describe_stream",
    "describe_strips",
    "diagrams",
    "map_chunks",
    "map_large_chunks",
    "shard_clouds",
    "strips",
]

T = TypeVar("T")

MAX_CHUNK_CLOUDS = 64
"""Largest number of clouds in a chunk."""

MAX_CHUNK_POINTS = 2**17
"""Largest number of points in a chunk, padding included."""

CHUNKS_PER_STEP = 4
"""Number of chunks in one step of the loop; XLA can run them concurrently."""

MAX_LARGE_CHUNK_POINTS = 2**19
"""Largest number of points in a large chunk, padding and all looks included."""

BATCH_AXIS = "batch"
"""Name of the only axis of the device mesh."""


def chunk_size(clouds: PointClouds) -> int:
    """Return the number of clouds in a chunk. On an accelerator the whole batch is one chunk."""
    n_clouds, capacity = clouds.mask.shape
    if jax.default_backend() != "cpu":
        return n_clouds
    return max(1, min(MAX_CHUNK_CLOUDS, MAX_CHUNK_POINTS // max(capacity, 1)))


def map_chunks(function: Callable[[PointClouds], T], clouds: PointClouds) -> T:
    """Return `function(clouds)`, computed `CHUNKS_PER_STEP` chunks at a time. Call it under `jax.jit`.

    Args:
        function: maps clouds [B, N] to arrays [B, ...] and treats each cloud separately.
        clouds: [B, N].
    """
    n_clouds, size = len(clouds.mask), chunk_size(clouds)
    clouds_per_step = size * CHUNKS_PER_STEP
    if n_clouds <= clouds_per_step:
        return _map_slices(function, clouds, size)
    n_steps, rest = divmod(n_clouds, clouds_per_step)
    head = jax.tree.map(lambda a: a[: n_clouds - rest].reshape(n_steps, clouds_per_step, *a.shape[1:]), clouds)
    results = jax.lax.map(lambda step: _map_slices(function, step, size), head)
    results = jax.tree.map(lambda a: a.reshape(n_clouds - rest, *a.shape[2:]), results)
    if rest == 0:
        return results
    tail = jax.tree.map(lambda a: a[n_clouds - rest :], clouds)
    return _concatenate([results, _map_slices(function, tail, size)])


def map_large_chunks(function: Callable[[PointClouds], T], clouds: PointClouds, looks: int) -> T:
    """Return `function(clouds)`, computed in large chunks.

    Args:
        function: maps clouds [B, N] to arrays [B, ...] and treats each cloud separately.
        clouds: [B, N].
        looks: number of looks at each cloud that the function describes.
    """
    n_clouds, capacity = clouds.mask.shape
    size = max(1, MAX_LARGE_CHUNK_POINTS // max(capacity * looks, 1))
    if jax.default_backend() != "cpu" or n_clouds <= size:
        return function(clouds)
    return _map_slices(function, clouds, size)


def _map_slices(function: Callable[[PointClouds], T], clouds: PointClouds, size: int) -> T:
    starts = range(0, max(len(clouds.mask), 1), size)
    return _concatenate([function(jax.tree.map(lambda a, k=k: a[k : k + size], clouds)) for k in starts])


def _concatenate(results: Sequence[T]) -> T:
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *results)


_default_parameters = functools.lru_cache(maxsize=8)(Parameters.of)


# This is compiled separately from `_strips_of`, whose scatter would otherwise repeat the look-up for every number.
_color_sets = jax.jit(color_sets)


@partial(jax.jit, static_argnums=3)
def _strips_of(aligned: PointClouds, region_set: jax.Array, sets: RegionSets, config: DescriptorConfig) -> Strips:
    planes = jnp.swapaxes(aligned.points, 1, 2)
    one = partial(strips_of_cloud, sets=sets, config=config)
    return jax.vmap(one)(planes, aligned.colors, aligned.mask, region_set)


_diagrams = jax.jit(diagrams_of_strips, static_argnums=1)


@partial(jax.jit, static_argnums=2)
def _describe_strips(strips: Strips, parameters: Parameters, config: DescriptorConfig) -> Descriptors:
    diagrams = diagrams_of_strips(strips, config)
    # E^i = (C^i Delta)^T
    embeddings = matmul(strips.color, parameters.similarity)
    return Descriptors(
        images=persistence_images(diagrams, config, parameters.image_variance, parameters.persistence_weight),
        embeddings=jnp.swapaxes(embeddings, -1, -2),
        overflow=strips.overflow + count_past_window(diagrams, config),
    )


def strips(aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> Strips:
    """Return the extremes and the colour vector of every strip: the input of the descriptors, which is much smaller.

    Args:
        aligned: clouds in scaled units, as `align` returns them.
        network: the colour network; only its regions are used.
        config: settings of the descriptor. Static.

    Raises:
        InputError: `aligned` is not a batch of clouds, or another argument is of another type.
    """
    check_batch(aligned)
    check_types(network=network, config=config)
    sets = region_sets(network)
    return _strips_of(aligned, _color_sets(aligned.colors, sets), sets, config)


def describe_strips(
    strips: Strips, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """Return the descriptors of `strips` (fields [B, S, J], scaled units).

    The other arguments, the result and the errors are those of `describe`.
    """
    check_types(strips=strips, network=network, config=config, parameters=parameters)
    return _describe_strips(strips, _default_parameters(network, config) if parameters is None else parameters, config)


def diagrams(aligned: PointClouds, config: DescriptorConfig) -> Diagrams:
    """Return the persistence diagrams of aligned clouds (paper, section "TOPS").

    Args:
        aligned: clouds in scaled units, as `align` returns them; their colours do not matter.
        config: settings of the descriptor. Static.

    Returns:
        Diagrams with fields [B, S, J], scaled units.

    Raises:
        InputError: `aligned` is not a batch of clouds, or `config` is of another type.
    """
    return _diagrams(strips(aligned, colornet.load_default(), config), config)


def describe_aligned(
    aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """Return the descriptors of clouds in scaled units that are already aligned, as `align` returns them.

    The other arguments, the result and the errors are those of `describe`.
    """
    return describe_strips(strips(aligned, network, config), network, config, parameters)


def describe(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """Return the descriptors TOPS, CE and TOPS2 of a batch of point clouds.

    The stages are, in order: view normalization, the rotation by alpha, slices and strips, persistence diagrams,
    persistence images and colour embeddings.

    The first call with a new shape [B, N], `config` or `network` compiles; later calls reuse the compiled program. N is
    the padded number of points: `PointClouds.pack` rounds the number of points of the largest cloud up to a point
    bucket (512, 1024, ..., 8192; see `thor2_jax.capacity`), so that few values of N ever occur. New values in the
    clouds or in `parameters` never cause a compilation.

    Gradients flow to the points, the colours and `parameters`; the frame of the view normalization is held constant.
    The choice of slices, strips and colour regions is piecewise constant, so that the gradient with respect to the
    colours and to alpha is exactly zero unless `config.relaxation` is set.

    Args:
        clouds: [B, N] clouds in metres.
        network: the colour network; it gives the colour regions and their similarity.
        config: settings of the descriptor. Static.
        parameters: replace the corresponding values of `network` and `config`.

    Returns:
        Descriptors of the B clouds, in the order of the batch. `images` [B, S, P, P] and `embeddings` [B, S, R, J] hold
        one entry for each slice, the lowest first. `tops` [B, S * P * P] are the images, `color` [B, S * R * J] the
        embeddings, and `tops2` has both, as one block [image | embedding] for each slice; all are flattened in C
        order. `overflow` [B] counts the points outside the grid of slices and strips plus the strips whose
        persistence exceeds the image window; it is 0 if the descriptor covers the whole cloud. An empty cloud has a
        descriptor of zeros.

    Raises:
        InputError: `clouds` is not a batch of clouds, its fields have other shapes, points or colours are not
            floating, or another argument is of another type.
    """
    check_batch(clouds)
    check_types(network=network, config=config, parameters=parameters)
    if len(clouds.mask) > chunk_size(clouds):
        return _describe_in_chunks(clouds, network, config, parameters)
    return describe_aligned(align(clouds, config, parameters), network, config, parameters)


@partial(jax.jit, static_argnums=(1, 2))
def _describe_in_chunks(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None
) -> Descriptors:
    return map_chunks(lambda chunk: describe(chunk, network, config, parameters), clouds)


def describe_stream(
    clouds: Iterable[tuple[Any, Any]],
    network: ColorNetwork,
    config: DescriptorConfig,
    capacity: int | None = None,
    batch: int = BATCH_BUCKETS[-1],
) -> Iterator[Descriptors]:
    """Describe clouds batch by batch, in order; memory use does not grow with their number.

    The next batch is packed while the previous one is computed.

    Args:
        clouds: pairs (xyz, rgb) as `PointClouds.pack` takes them, read lazily.
        network: the colour network.
        config: settings of the descriptor. Static.
        capacity: padded number of points; by default the bucket of each batch's largest cloud.
        batch: number of clouds described together; each value compiles once.

    Yields:
        Descriptors of up to `batch` clouds, as NumPy arrays.

    Raises:
        InputError: `batch` is not a positive integer, or `PointClouds.pack` refuses a cloud; the message gives the
            index of the cloud in its batch.
    """
    if not isinstance(batch, int | np.integer) or batch < 1:
        raise InputError(f"batch is {batch!r}; expected a positive integer")
    return _stream(iter(clouds), network, config, capacity, batch)


def _stream(
    clouds: Iterator[tuple[Any, Any]], network: ColorNetwork, config: DescriptorConfig, capacity: int | None, batch: int
) -> Iterator[Descriptors]:
    empty_cloud = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    running: list[tuple[int, Descriptors]] = []
    while chunk := list(itertools.islice(clouds, batch)):
        packed = PointClouds.pack(chunk + [empty_cloud] * (batch - len(chunk)), capacity)
        running.append((len(chunk), describe(packed, network, config)))
        if len(running) > 1:
            yield _fetch(*running.pop(0))
    yield from (_fetch(*last) for last in running)


def _fetch(count: int, descriptors: Descriptors) -> Descriptors:
    return jax.tree.map(lambda a: np.asarray(a)[:count], descriptors)


def batch_mesh(devices: Sequence[Any] | None = None) -> Mesh:
    """Return a mesh of devices, by default all devices of all processes, along the axis "batch"."""
    return Mesh(np.asarray(jax.devices() if devices is None else devices), (BATCH_AXIS,))


def shard_clouds(clouds: PointClouds, mesh: Mesh) -> PointClouds:
    """Distribute a batch over the devices of `mesh`.

    Args:
        clouds: [B, N]. With several processes, the clouds of this process; B and N must be equal in all processes.
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


@partial(jax.jit, static_argnums=(1, 2, 3))
def _sharded(clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, mesh: Mesh) -> Descriptors:
    spec, local = PartitionSpec(BATCH_AXIS), partial(describe, network=network, config=config)
    return jax.shard_map(local, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)(clouds)


def describe_sharded(clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> Descriptors:
    """Describe a sharded batch: each device describes its own clouds, without communication between devices.

    Args:
        clouds: as `shard_clouds` returns them.
        network: the colour network.
        config: settings of the descriptor. Static.

    Returns:
        Descriptors sharded like the clouds; a process reads its own descriptors through `addressable_shards`.

    Raises:
        InputError: `clouds` does not come from `shard_clouds`, or another argument is of another type.
    """
    check_batch(clouds)
    check_types(network=network, config=config)
    sharding = getattr(clouds.points, "sharding", None)
    if not isinstance(sharding, NamedSharding) or sharding.mesh.axis_names != (BATCH_AXIS,):
        raise InputError(f"clouds has the sharding {sharding}; expected clouds from shard_clouds")
    return _sharded(clouds, network, config, sharding.mesh)
