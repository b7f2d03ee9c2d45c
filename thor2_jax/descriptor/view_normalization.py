"""View normalization and the rotation by alpha (paper, sections "View normalization" and "Slicing").

View normalization rotates a cloud to a pose that does not depend on the camera's pose; `turn` prepares slicing.

>>> clouds = PointClouds.pack([(xyz, rgb)])                      # doctest: +SKIP
>>> normal = view_normalize(clouds, DescriptorConfig())          # doctest: +SKIP
>>> aligned = turn(normal, DescriptorConfig())                   # doctest: +SKIP   the same as align(clouds, config)
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.bounding_box import HIGHEST, ROWS, fold, minimal_box, rotate
from thor2_jax.errors import InputError
from thor2_jax.types import Parameters, PointClouds, check_batch, check_types

__all__ = ["Normalization", "align", "mirror", "normalization_of", "place_aligned", "turn", "view_normalize"]

OCCLUSION_BIN = 0.01
"""Width of the bins along x in which boundary points are counted, scaled units."""


def _sigma_s_and_alpha(config: DescriptorConfig, parameters: Parameters | None) -> tuple[ArrayLike, ArrayLike]:
    check_types(config=config, parameters=parameters)
    if parameters is None:
        return np.float32(config.sigma_s), np.float32(config.alpha)
    return parameters.sigma_s, parameters.alpha


def _planes(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
    """Return points [3, M] and mask [M] of a cloud; M is N rounded up to a multiple of `ROWS`."""
    padding = -cloud.mask.shape[0] % ROWS
    return jnp.pad(cloud.points, ((0, padding), (0, 0))).T, jnp.pad(cloud.mask, (0, padding))


def _place(rotation: jax.Array, points: jax.Array, mask: jax.Array, camera: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rotate points [3, M] and camera [3] and translate them to the first octant; padding is 0."""
    points = rotate(rotation, points)
    low = jnp.where(mask, points, jnp.inf).min(axis=1)
    low = jnp.where(jnp.isfinite(low), low, 0)
    return jnp.where(mask, points - low[:, None], 0), jnp.matmul(rotation, camera, precision=HIGHEST) - low


class Normalization(NamedTuple):
    """The rotation of the view normalization of one cloud, and the cloud before this rotation.

    Attributes:
        rotation: [3, 3], axes of the minimal box with their signs as rows, the longest side first.
        end_is_occluded: [] bool, whether an occluded end caused the half turn about z.
        points: [3, M], scaled units, mean zero; padding is 0.
        mask: [M] bool, False on padding.
        camera: [3], position of the camera relative to the mean.
    """

    rotation: jax.Array
    end_is_occluded: jax.Array
    points: jax.Array
    mask: jax.Array
    camera: jax.Array


def normalization_of(cloud: PointClouds, sigma_s: ArrayLike) -> Normalization:
    """Scale and centre one cloud, find its minimal box, and choose the signs of the axes."""
    points, mask = _planes(cloud)
    scaled = points * sigma_s
    centre = fold(jnp.where(mask, scaled, 0), jnp.add).sum(axis=1) / jnp.maximum(mask.sum(dtype=scaled.dtype), 1)
    # Padding moves to the mean, inside the convex hull, where it is never an extreme point.
    centred = jnp.where(mask, scaled - centre[:, None], 0)
    camera = cloud.camera * sigma_s - centre
    axes, low, high = minimal_box(centred)
    middle = (low + high) / 2

    # The mean is the origin, so a positive middle means that the mean lies below the middle.
    x_sign = jnp.where(middle[0] < 0, -1.0, 1.0)
    # A half turn about x moves a camera from +z to -z.
    camera_z = jnp.matmul(axes[2], camera, precision=HIGHEST) - middle[2]
    z_sign = jnp.where(camera_z > 0, -1.0, 1.0)

    x_low = jnp.minimum(low[0] * x_sign, high[0] * x_sign)
    bins = jnp.floor(rotate(axes[:1], centred)[0] * x_sign / OCCLUSION_BIN - x_low / OCCLUSION_BIN)
    last = jnp.where(mask, bins, -1).max()
    # A half turn about z moves the occluded end away from the first slice.
    boundary = jnp.pad(cloud.boundary, (0, len(mask) - len(cloud.boundary))) & mask
    first_end, last_end = ((boundary & end).sum() for end in (bins <= 1, bins >= last - 1))
    x_sign = jnp.where(first_end > last_end, -x_sign, x_sign)

    x, z = axes[0] * x_sign, axes[2] * z_sign
    rotation = jax.lax.stop_gradient(jnp.stack([x, jnp.cross(z, x), z]))
    return Normalization(rotation, first_end != last_end, centred, mask, camera)


def view_normalize(clouds: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> PointClouds:
    """Rotate each cloud to the axes of its minimal box, and translate it to the first octant.

    The steps follow the section "View normalization" of the paper:

    1. Rotate the cloud to the axes of an approximately minimal-volume box, longest side along x (`bounding_box`).
    2. If the camera is on the +z side of the middle of the box, apply a half turn about x.
    3. If the mean of the points is above the middle of the box along x, apply a half turn about z, so that the end with
       more points comes first.
    4. If the first two bins of 0.01 along x then contain more points of the occlusion boundary than the last two, apply
       a half turn about z, so that the occluded end is not in the first slice.
    5. Translate the cloud to the first octant.

    A rigid motion of cloud and camera together does not change the result. Cubes and balls have no unique box; any
    minimal box may be chosen. Gradients treat the rotation as a constant, because it is discontinuous where another
    face becomes flush with the box and has no derivative where eigenvalues are equal.

    Args:
        clouds: metres, in any frame; the camera is in the same frame.
        config: only `sigma_s` is used. Static.
        parameters: if given, replace the values of `config`. New values do not cause a compilation.

    Returns:
        Clouds in scaled units, with the camera in the same frame; colours, mask and boundary are unchanged.

    Raises:
        InputError: `clouds` is not a batch of clouds, or another argument is of another type.
    """
    sigma_s, _ = _sigma_s_and_alpha(config, parameters)
    return _normalized_and_turned(clouds, sigma_s, jnp.zeros_like(sigma_s))


def _about_y(alpha: ArrayLike) -> jax.Array:
    c, s = jnp.cos(alpha), jnp.sin(alpha)
    return jnp.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


@jax.jit
def _turn(normal: PointClouds, alpha: ArrayLike) -> PointClouds:
    def one(cloud: PointClouds) -> PointClouds:
        points, camera = _place(_about_y(alpha), *_planes(cloud), cloud.camera)
        return dataclasses.replace(cloud, points=points.T[: len(cloud.mask)], camera=camera)

    return jax.vmap(one)(normal)


def turn(normal: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> PointClouds:
    """Rotate normalized clouds by -alpha about y; the long axis then has the angle alpha to the x-y plane ("Slicing").

    Args:
        normal: clouds as `view_normalize` or `mirror` return them.
        config: only `alpha` is used. Static.
        parameters: if given, replace the values of `config`. New values do not cause a compilation.

    Returns:
        Aligned clouds in scaled units, in the first octant.

    Raises:
        InputError: `normal` is not a batch of clouds, or another argument is of another type.
    """
    check_batch(normal)
    return _turn(normal, _sigma_s_and_alpha(config, parameters)[1])


def place_aligned(rotation: jax.Array, normalization: Normalization, alpha: ArrayLike) -> tuple[jax.Array, jax.Array]:
    """Rotate one cloud, also by alpha, and translate it to the first octant; return points [M, 3] and camera [3]."""
    # One rotation suffices, since the translation between the two rotations would cancel.
    turned = jnp.matmul(_about_y(alpha), rotation, precision=HIGHEST)
    points, camera = _place(turned, normalization.points, normalization.mask, normalization.camera)
    return points.T, camera


def _normalized_and_turned(clouds: PointClouds, sigma_s: ArrayLike, alpha: ArrayLike) -> PointClouds:
    check_batch(clouds)
    points, camera = _align(clouds, sigma_s, alpha)
    return dataclasses.replace(clouds, points=points, camera=camera)  # compiled, it would copy the other fields


@jax.jit
def _align(clouds: PointClouds, sigma_s: ArrayLike, alpha: ArrayLike) -> tuple[jax.Array, jax.Array]:
    def one(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
        normalization = normalization_of(cloud, sigma_s)
        points, camera = place_aligned(normalization.rotation, normalization, alpha)
        return points[: len(cloud.mask)], camera

    return jax.vmap(one)(clouds)


def align(clouds: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> PointClouds:
    """Return `turn(view_normalize(clouds, config), config)`: aligned clouds in scaled units, ready for slicing.

    Raises InputError as both.
    """
    return _normalized_and_turned(clouds, *_sigma_s_and_alpha(config, parameters))


def mirror(normal: PointClouds, axes: str) -> PointClouds:
    """Mirror normalized clouds within their boxes (paper, "Training": each view is also mirrored in x, y and xy).

    Args:
        normal: clouds in the first octant.
        axes: axes to mirror, letters of "xyz"; "" returns equal clouds. Static.

    Raises:
        InputError: `normal` is not a batch of clouds, or `axes` has another letter.
    """
    check_batch(normal)
    if not isinstance(axes, str) or not set(axes) <= set("xyz"):
        raise InputError(f"axes is {axes!r}; expected letters of 'xyz'")
    return _mirror(normal, axes)


@partial(jax.jit, static_argnums=1)
def _mirror(normal: PointClouds, axes: str) -> PointClouds:
    flip = jnp.array([letter in axes for letter in "xyz"])
    high = jnp.where(normal.mask[..., None], normal.points, 0).max(axis=1, keepdims=True)
    points = jnp.where(flip & normal.mask[..., None], high - normal.points, normal.points)
    camera = jnp.where(flip, high[:, 0] - normal.camera, normal.camera)
    return dataclasses.replace(normal, points=points, camera=camera)
