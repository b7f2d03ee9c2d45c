"""The complete pipeline from point clouds to TOPS and TOPS2 (paper, sections "TOPS" and "TOPS2").

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
from thor2_jax.descriptor.chunking import chunk_size, map_chunks
from thor2_jax.descriptor.color_membership import RegionSets, color_sets, region_sets
from thor2_jax.descriptor.persistence import diagrams_of_strips
from thor2_jax.descriptor.persistence_images import count_past_window, persistence_images
from thor2_jax.descriptor.slicing import strips_of_cloud
from thor2_jax.descriptor.view_normalization import align
from thor2_jax.errors import InputError
from thor2_jax.parameters import Parameters
from thor2_jax.types import Descriptors, Diagrams, PointClouds, Strips

__all__ = ["describe", "describe_aligned", "describe_strips", "diagrams", "strips", "strips_by_sets"]


@functools.lru_cache(maxsize=8)
def _region_sets(network: ColorNetwork) -> RegionSets:
    # The result outlives the call, so it must be concrete even if the first call happens while a function is traced.
    with jax.ensure_compile_time_eval():
        return region_sets(network)


_default_parameters = functools.lru_cache(maxsize=8)(Parameters.of)


def _check_batch(clouds: PointClouds) -> None:
    if not isinstance(clouds, PointClouds) or clouds.points.ndim != 3:
        actual = f"points {list(clouds.points.shape)}" if isinstance(clouds, PointClouds) else type(clouds).__name__
        raise InputError(f"clouds is {actual}; expected PointClouds with points [B, N, 3]; use PointClouds.pack")


# Compiled apart from `_strips_of`: fused into its scatter, the look-up would be repeated, one number at a time.
_color_sets = jax.jit(color_sets)


@partial(jax.jit, static_argnums=3)
def _strips_of(aligned: PointClouds, region_set: jax.Array, sets: RegionSets, config: DescriptorConfig) -> Strips:
    planes = jnp.swapaxes(aligned.points, 1, 2)
    one = partial(strips_of_cloud, sets=sets, config=config)
    return jax.vmap(one)(planes, aligned.colors, aligned.mask, region_set)


def strips_by_sets(aligned: PointClouds, sets: RegionSets, config: DescriptorConfig) -> Strips:
    """Return `strips` with the given region sets instead of those of a network."""
    return _strips_of(aligned, _color_sets(aligned.colors, sets), sets, config)


_diagrams = jax.jit(diagrams_of_strips, static_argnums=1)


@partial(jax.jit, static_argnums=2)
def _describe_strips(strips: Strips, parameters: Parameters, config: DescriptorConfig) -> Descriptors:
    diagrams = diagrams_of_strips(strips, config)
    # E^i = (C^i Delta)^T
    embeddings = jnp.matmul(strips.color, parameters.similarity, precision=jax.lax.Precision.HIGHEST)
    return Descriptors(
        images=persistence_images(diagrams, config, parameters.image_variance, parameters.persistence_weight),
        embeddings=jnp.swapaxes(embeddings, -1, -2),
        overflow=strips.overflow + count_past_window(diagrams, config),
    )


def strips(aligned: PointClouds, network: ColorNetwork, config: DescriptorConfig) -> Strips:
    """Return the extremes and the colour vector of every strip: all that descriptors need, at a fraction of their size.

    Args:
        aligned: clouds in scaled units, as `align` returns them.
        network: the colour network, of which only the regions are used.
        config: static.
    """
    _check_batch(aligned)
    return strips_by_sets(aligned, _region_sets(network), config)


def describe_strips(
    strips: Strips, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None = None
) -> Descriptors:
    """Return the descriptors of `strips` (fields [B, S, J], scaled units); the rest is as in `describe`."""
    return _describe_strips(strips, _default_parameters(network, config) if parameters is None else parameters, config)


def diagrams(aligned: PointClouds, config: DescriptorConfig) -> Diagrams:
    """Return the persistence diagrams, fields [B, S, J] in scaled units, of aligned clouds. Colours are not used."""
    _check_batch(aligned)
    one_set = RegionSets(jnp.zeros(GRID_SIZE, jnp.int32), jnp.ones((1, 1), jnp.float32))
    return _diagrams(strips_by_sets(aligned, one_set, config), config)


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

    The stages are, in order: view normalization, the turn by alpha, slices and strips, persistence diagrams,
    persistence images and colour embeddings.

    The first call with a new shape [B, N], `config` or `network` compiles; later calls reuse the compiled program. N is
    the padded number of points: `PointClouds.pack` rounds the number of points of the largest cloud up to a point
    bucket (512, 1024, ..., 8192; see `thor2_jax.capacity`), so that few values of N ever occur. Other values of the
    clouds or of `parameters` never cause a compilation.

    Gradients reach the points, the colours and `parameters`; the frame of the view normalization is held constant.
    The choice of slices, strips and colour regions is piecewise constant, so that the gradient with respect to the
    colours and to alpha is exactly zero unless `config.relaxation` is set.

    Args:
        clouds: [B, N] clouds in metres.
        network: the colour network; it gives the colour regions and their similarity.
        config: static.
        parameters: replace the corresponding numbers of `network` and `config`.

    Returns:
        Descriptors of the B clouds, in the order of the batch. `images` [B, S, P, P] and `embeddings` [B, S, R, J] hold
        one entry for each slice, the lowest first. `tops` [B, S * P * P] are the images, `color` [B, S * R * J] the
        embeddings, and `tops2` has both, as one block [image | embedding] for each slice; each of them is flattened in
        C order. `overflow` [B] counts the points outside the grid of slices and strips plus the strips whose
        persistence exceeds the image window; it is 0 if the descriptor covers the whole cloud. An empty cloud has a
        descriptor of zeros.

    Raises:
        InputError: `clouds` is not a batch of clouds.
    """
    _check_batch(clouds)
    if len(clouds.mask) > chunk_size(clouds):
        return _describe_in_chunks(clouds, network, config, parameters)
    return describe_aligned(align(clouds, config, parameters), network, config, parameters)


@partial(jax.jit, static_argnums=(1, 2))
def _describe_in_chunks(
    clouds: PointClouds, network: ColorNetwork, config: DescriptorConfig, parameters: Parameters | None
) -> Descriptors:
    return map_chunks(lambda chunk: describe(chunk, network, config, parameters), clouds)
