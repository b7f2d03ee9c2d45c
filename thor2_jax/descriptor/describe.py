"""The whole way from clouds to TOPS and TOPS2 (paper, sections "TOPS" and "TOPS2").

>>> import colornet, thor2_jax as thor2
>>> network, config = colornet.load_default(), thor2.DescriptorConfig(homology="closed_form")
>>> clouds = thor2.PointClouds.pack([(np.random.rand(1000, 3) / 10, np.random.rand(1000, 3))])
>>> thor2.describe(clouds, network, config).tops2.shape
(1, 11942)
"""

import functools
from functools import partial

import jax
import jax.numpy as jnp

from colornet import ColorNetwork
from colornet.grid import GRID_SIZE
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.chunking import in_parts, part_size
from thor2_jax.descriptor.color_membership import RegionSets, color_sets, region_sets
from thor2_jax.descriptor.persistence import diagrams_of_strips
from thor2_jax.descriptor.persistence_images import past_window, persistence_images
from thor2_jax.descriptor.slicing import strips_of_cloud
from thor2_jax.descriptor.view_normalization import align_planes
from thor2_jax.errors import InputError
from thor2_jax.parameters import Parameters
from thor2_jax.types import Descriptors, Diagrams, PointClouds, Strips

__all__ = ["describe", "describe_aligned", "describe_strips", "diagrams", "strips", "strips_by_sets"]


@functools.lru_cache(maxsize=8)
def _region_sets(network: ColorNetwork) -> RegionSets:
    # Kept for later calls, so they must be arrays also when the first call happens while a caller's function is traced.
    with jax.ensure_compile_time_eval():
        return region_sets(network)


_default_parameters = functools.lru_cache(maxsize=8)(Parameters.of)


def _check(clouds: PointClouds) -> None:
    if not isinstance(clouds, PointClouds) or clouds.points.ndim != 3:
        found = f"points {list(clouds.points.shape)}" if isinstance(clouds, PointClouds) else type(clouds).__name__
        raise InputError(f"clouds is {found}; expected PointClouds with points [B, N, 3] (see PointClouds.pack)")


# Apart from `_strips_of`: fused into its scatter, the look-up would be made again and again, one number at a time.
_color_sets = jax.jit(color_sets)


@partial(jax.jit, static_argnums=5)
def _strips_of_planes(
    points: jax.Array,
    colors: jax.Array,
    mask: jax.Array,
    set_of_point: jax.Array,
    sets: RegionSets,
    config: DescriptorConfig,
) -> Strips:
    one = partial(strips_of_cloud, sets=sets, config=config)
    return jax.vmap(one)(points, colors, mask, set_of_point)


@partial(jax.jit, static_argnums=3)
def _strips_of(aligned: PointClouds, set_of_point: jax.Array, sets: RegionSets, config: DescriptorConfig) -> Strips:
    planes = jnp.swapaxes(aligned.points, 1, 2)
    return _strips_of_planes(planes, aligned.colors, aligned.mask, set_of_point, sets, config)


def strips_by_sets(aligned: PointClouds, sets: RegionSets, config: DescriptorConfig) -> Strips:
    """`strips` with any weights of the sets that colours belong to, in place of a network's."""
    return _strips_of(aligned, _color_sets(aligned.colors, sets), sets, config)


@partial(jax.jit, static_argnums=1)
def _diagrams(strips: Strips, config: DescriptorConfig) -> Diagrams:
    return diagrams_of_strips(strips, config)


@partial(jax.jit, static_argnums=2)
def _describe_strips(strips: Strips, parameters: Parameters, config: DescriptorConfig) -> Descriptors:
    found = diagrams_of_strips(strips, config)
    # E^i = (C^i Delta)^T
    embeddings = jnp.matmul(strips.color, parameters.similarity, precision=jax.lax.Precision.HIGHEST)
    return Descriptors(
        images=persistence_images(found, config, parameters.image_variance, parameters.persistence_weight),
        embeddings=jnp.swapaxes(embeddings, -1, -2),
        overflow=strips.overflow + past_window(found, config),
    )


def strips(aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> Strips:
    """Extremes and colour vectors of every strip: all that the descriptors need, and a fraction of their size.

    Args:
        aligned: scaled units, as `align` returns them.
        network: gives the colour regions.
        config: static; another one compiles again, as does another shape of `aligned`.
    """
    _check(aligned)
    return strips_by_sets(aligned, _region_sets(network), config)


def describe_strips(
    strips: Strips, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """Persistence images and colour embeddings of `strips` (fields [B, S, J]); the rest as in `describe`."""
    return _describe_strips(strips, _default_parameters(network, config) if parameters is None else parameters, config)


def diagrams(aligned: PointClouds, config: DescriptorConfig) -> Diagrams:
    """Persistence diagrams of aligned clouds, fields [B, S, J]. Colours play no part."""
    _check(aligned)
    one_set = RegionSets(jnp.zeros(GRID_SIZE, jnp.int32), jnp.ones((1, 1), jnp.float32))
    return _diagrams(strips_by_sets(aligned, one_set, config), config)


def describe_aligned(
    aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """TOPS, CE and TOPS2 of clouds that are aligned already (scaled units, first octant, turned by alpha).

    The arguments are those of `describe`.

    Raises:
        InputError: `aligned` is no batch of clouds.
    """
    return describe_strips(strips(aligned, network, config), network, config, parameters)


def describe(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """TOPS, CE and TOPS2 of clouds as the camera saw them.

    View normalization, turn, slices, diagrams, images, embeddings. Gradients reach points, colours and parameters; the
    frame of the view normalization counts as fixed. What points and parameters change through the choice of slices,
    strips and colour regions alone has a gradient of exactly zero (colours, alpha) unless the config relaxes it.

    Args:
        clouds: [B, N] clouds in metres.
        network: the colour network; its regions and similarity fix the colour part.
        config: static; another one compiles again, as does another B or N.
        parameters: take the place of the network's and the config's where given. Other values compile nothing.

    Returns:
        Descriptors of the B clouds. An empty cloud's are zero.

    Raises:
        InputError: `clouds` is no batch of clouds.
    """
    _check(clouds)
    if len(clouds.mask) > part_size(clouds):
        return _describe_in_parts(clouds, network, config, parameters)
    return _describe_part(clouds, network, config, parameters)


def _describe_part(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None
) -> Descriptors:
    sets = _region_sets(network)
    planes = align_planes(clouds, config, parameters)
    found = _strips_of_planes(planes, clouds.colors, clouds.mask, _color_sets(clouds.colors, sets), sets, config)
    return describe_strips(found, network, config, parameters)


@partial(jax.jit, static_argnums=(1, 2))
def _describe_in_parts(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None
) -> Descriptors:
    return in_parts(lambda part: _describe_part(part, network, config, parameters), clouds)
