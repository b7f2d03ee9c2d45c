"""View normalization and the turn by alpha (paper, sections "View normalization" and "Slicing").

From a cloud as the camera saw it to one that stands the same way whatever the camera's pose; turned, it can be sliced.

>>> clouds = PointClouds.pack([(xyz, rgb)])                      # doctest: +SKIP
>>> normal = view_normalize(clouds, DescriptorConfig())          # doctest: +SKIP
>>> aligned = turn(normal, DescriptorConfig())                   # doctest: +SKIP   the same as align(clouds, config)
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.bounding_box import HIGHEST, minimal_box, rotate
from thor2_jax.descriptor.reductions import ROWS, largest, smallest, total
from thor2_jax.errors import InputError
from thor2_jax.parameters import Parameters
from thor2_jax.types import PointClouds

__all__ = ["align", "align_planes", "mirror", "turn", "view_normalize"]

OCCLUSION_BIN = 0.01
"""Width in scaled units of the x-bins in which boundary points are counted; two at either end decide."""


def _sigma_s_and_alpha(config: DescriptorConfig, parameters: Parameters | None) -> tuple[ArrayLike, ArrayLike]:
    if parameters is None:
        return np.float32(config.sigma_s), np.float32(config.alpha)
    return parameters.sigma_s, parameters.alpha


def _planes(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
    """Coordinates [3, M] and mask [M] of a cloud; M is N, rounded up to what reductions need."""
    missing = -cloud.mask.shape[0] % ROWS
    return jnp.pad(cloud.points, ((0, missing), (0, 0))).T, jnp.pad(cloud.mask, (0, missing))


def _place(rotation: jax.Array, points: jax.Array, mask: jax.Array, camera: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Points [3, M] and camera [3], rotated and moved so that the least coordinate along each axis is 0; padding 0."""
    points = rotate(rotation, points)
    low = smallest(jnp.where(mask, points, jnp.inf))
    low = jnp.where(jnp.isfinite(low), low, 0)
    return jnp.where(mask, points - low[:, None], 0), jnp.matmul(rotation, camera, precision=HIGHEST) - low


def _count(flags: jax.Array) -> jax.Array:
    """Number of true flags [M], as a float: sums of floats are quicker here, and exact for any cloud in memory."""
    return total(flags.astype(jnp.float32))


def _frame(cloud: PointClouds, sigma_s: ArrayLike) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The view normalization's rotation [3, 3] and what it turns: points [3, M] about their mean, mask, camera."""
    points, mask = _planes(cloud)
    scaled = points * sigma_s
    centre = total(jnp.where(mask, scaled, 0)) / jnp.maximum(_count(mask), 1)
    # Padding moves to the mean: within the hull of the cloud, it never is an extreme.
    centred = jnp.where(mask, scaled - centre[:, None], 0)
    camera = cloud.camera * sigma_s - centre

    axes, low, high = minimal_box(centred)
    middle = (low + high) / 2

    # The mean is the origin here: the heavier half lies below the middle where the middle is positive.
    x_sign = jnp.where(middle[0] < 0, -1.0, 1.0)
    # A half turn about x brings a camera on +z to -z.
    camera_z = jnp.matmul(axes[2], camera, precision=HIGHEST) - middle[2]
    z_sign = jnp.where(camera_z > 0, -1.0, 1.0)

    x_low = jnp.minimum(low[0] * x_sign, high[0] * x_sign)
    bins = jnp.floor(rotate(axes[:1], centred)[0] * x_sign / OCCLUSION_BIN - x_low / OCCLUSION_BIN)
    last = largest(jnp.where(mask, bins, -1))
    edge = jnp.pad(cloud.boundary, (0, len(mask) - len(cloud.boundary))) & mask
    # A half turn about z takes the occluded end away from the first slice.
    x_sign = jnp.where(_count(edge & (bins <= 1)) > _count(edge & (bins >= last - 1)), -x_sign, x_sign)

    x, z = axes[0] * x_sign, axes[2] * z_sign
    return jax.lax.stop_gradient(jnp.stack([x, jnp.cross(z, x), z])), centred, mask, camera


def _normalize_one(cloud: PointClouds, sigma_s: ArrayLike) -> PointClouds:
    points, camera = _place(*_frame(cloud, sigma_s))
    return dataclasses.replace(cloud, points=points.T[: len(cloud.mask)], camera=camera)


@jax.jit
def _view_normalize(clouds: PointClouds, sigma_s: ArrayLike) -> PointClouds:
    return jax.vmap(lambda cloud: _normalize_one(cloud, sigma_s))(clouds)


def view_normalize(clouds: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> PointClouds:
    """Rotate each cloud onto its minimal box, longest side along x, seen from -z, in the first octant.

    The steps of the paper's section "View normalization": (1, 2) axes of an approximately minimal-volume box, longest
    first (`bounding_box`); (3) a camera on the +z side of the box's middle means a half turn about x; (5) what is then
    free, a half turn about z, puts the mean of the points at or below the middle of the box along x, so that the end
    with more of the cloud comes first; (4) if the first two x-bins of 0.01 hold more occlusion-boundary points than the
    last two, a half turn about z keeps the occluded end out of the first slice; (6) translation to the first octant.
    Every step follows the cloud and the camera: a rigid motion of both changes nothing. Cubes and balls have no unique
    box; their frame is one of the equal ones. A gradient sees the frame as fixed: it jumps where another face of the
    box becomes flush, and equal eigenvalues have no derivative.

    Args:
        clouds: metres, any frame, camera given in the same one.
        config: only `sigma_s` is used.
        parameters: take the place of the config's where given. Other values compile nothing.

    Returns:
        Clouds in scaled units; `camera` moved along; colours, mask and boundary as they were.
    """
    return _view_normalize(clouds, _sigma_s_and_alpha(config, parameters)[0])


def _about_y(alpha: ArrayLike) -> jax.Array:
    c, s = jnp.cos(alpha), jnp.sin(alpha)
    return jnp.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def _turn_one(cloud: PointClouds, alpha: ArrayLike) -> PointClouds:
    points, camera = _place(_about_y(alpha), *_planes(cloud), cloud.camera)
    return dataclasses.replace(cloud, points=points.T[: len(cloud.mask)], camera=camera)


@jax.jit
def _turn(normal: PointClouds, alpha: ArrayLike) -> PointClouds:
    return jax.vmap(lambda cloud: _turn_one(cloud, alpha))(normal)


def turn(normal: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> PointClouds:
    """Turn normalized clouds by -alpha about y (paper, "Slicing").

    The long axis then stands at alpha to the x-y plane.

    Args:
        normal: clouds as `view_normalize` returns them, or mirrored ones.
        config: only `alpha` is used.
        parameters: take the place of the config's where given. Other values compile nothing.

    Returns:
        The aligned clouds, scaled units, in the first octant.
    """
    return _turn(normal, _sigma_s_and_alpha(config, parameters)[1])


@jax.jit
def _align_planes(clouds: PointClouds, sigma_s: ArrayLike, alpha: ArrayLike) -> tuple[jax.Array, jax.Array]:
    def one(cloud: PointClouds) -> tuple[jax.Array, jax.Array]:
        frame, points, mask, camera = _frame(cloud, sigma_s)
        # One rotation: the shift between the two would cancel.
        rotation = jnp.matmul(_about_y(alpha), frame, precision=HIGHEST)
        points, camera = _place(rotation, points, mask, camera)
        return points[:, : len(cloud.mask)], camera  # the rest of the cloud would be copied

    return jax.vmap(one)(clouds)


@jax.jit
def _align(clouds: PointClouds, sigma_s: ArrayLike, alpha: ArrayLike) -> tuple[jax.Array, jax.Array]:
    planes, camera = _align_planes(clouds, sigma_s, alpha)
    return jnp.swapaxes(planes, 1, 2), camera


def align(clouds: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> PointClouds:
    """`turn` of `view_normalize`: clouds in metres to aligned clouds in scaled units, ready to be sliced."""
    points, camera = _align(clouds, *_sigma_s_and_alpha(config, parameters))
    return dataclasses.replace(clouds, points=points, camera=camera)


def align_planes(clouds: PointClouds, config: DescriptorConfig, parameters: Parameters | None = None) -> jax.Array:
    """The points of `align` as planes, [B, 3, N], which spares those who slice them next two transpositions."""
    return _align_planes(clouds, *_sigma_s_and_alpha(config, parameters))[0]


@partial(jax.jit, static_argnums=1)
def mirror(normal: PointClouds, axes: str) -> PointClouds:
    """Mirror normalized clouds within their boxes (paper, "Training": each view also mirrored in x, y and xy).

    Args:
        normal: clouds in the first octant.
        axes: letters of "xyz" to mirror in; "" returns the clouds as they are. Static.

    Raises:
        InputError: `axes` has another letter.
    """
    if not set(axes) <= set("xyz"):
        raise InputError(f"axes is {axes!r}; expected letters of 'xyz'")
    flip = jnp.array([letter in axes for letter in "xyz"])
    high = jnp.where(normal.mask[..., None], normal.points, 0).max(axis=1, keepdims=True)
    points = jnp.where(flip & normal.mask[..., None], high - normal.points, normal.points)
    camera = jnp.where(flip, high[:, 0] - normal.camera, normal.camera)
    return dataclasses.replace(normal, points=points, camera=camera)
