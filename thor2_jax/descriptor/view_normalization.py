"""View normalization and the rotation by alpha (paper, sections "View normalization" and "Slicing").

>>> clouds = PointClouds.pack([(xyz, rgb)])                      # doctest: +SKIP
>>> normal = view_normalize(clouds, DescriptorConfig())          # doctest: +SKIP
>>> aligned = turn(normal, DescriptorConfig())  # equals align(clouds, config)   # doctest: +SKIP

View normalization rotates a cloud to a pose that does not depend on the camera's pose: that of an approximately
minimal-volume oriented bounding box (O'Rourke 1985). Along each of its axes, a minimal box projects to a minimum-area
rectangle of the projected cloud. The search alternates over the axes: it keeps one axis and rotates the other two to
the minimum-area rectangle. It uses support points only (the vertices of the convex hull that are extreme in a fixed set
of directions), so that its cost does not depend on the number of points. `turn` then prepares slicing.

XLA reduces floats along the last axis one at a time. `fold` and `argmax` combine rows of the axis elementwise, which is
several times as fast. They use `jax.lax`, since indexing and `jnp.where` take a fifth longer to compile.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.types import Parameters, PointClouds, check_batch, check_types, matmul

__all__ = ["ROWS", "Normalization", "align", "mirror", "normalization_of", "place_aligned", "turn", "view_normalize"]

ROWS = 16
"""Number of rows into which the last axis is folded; its length must be a multiple of this number."""

_PLAIN_LENGTH = 8
"""Largest length at which a plain argmax is as fast as halving."""

SWEEPS = 6
"""Number of minimum-area rectangles for each start, two about each axis; more do not shrink the boxes of real scans."""

LANES = 16
"""Number of support points that are rotated at a time."""

COARSE_ANGLES = 17
"""Number of angles in a quarter turn. Two rounds of 9 finer angles around the best lead to steps of 0.33 degrees."""


def _half_sphere() -> np.ndarray:
    """Return [33, 3] float32 unit vectors, no two of them opposite: integer points with |i| + |j| + |k| = 4.

    The set of lines along them does not change if an axis is reflected: eigenvectors have arbitrary signs, and the box
    must not depend on these signs.
    """
    points = (p for p in itertools.product(range(-4, 5), repeat=3) if sum(map(abs, p)) == 4 and p < (0, 0, 0))
    directions = np.array(list(points), np.float64)
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


_DIRECTIONS = _half_sphere()


def larger(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return `jnp.maximum(a, b)` of numbers other than NaN, in one instruction; propagating NaN would take more."""
    return jax.lax.select(jax.lax.gt(a, b), a, b)


def smaller(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return `jnp.minimum(a, b)` of numbers other than NaN, in one instruction."""
    return jax.lax.select(jax.lax.lt(a, b), a, b)


def rows_of(folded: jax.Array) -> list[jax.Array]:
    """Return `[folded[..., k, :] for k in range(K)]`, [..., K, N]."""
    return [jax.lax.index_in_dim(folded, k, axis=-2, keepdims=False) for k in range(folded.shape[-2])]


def fold(values: jax.Array, op: Callable[[jax.Array, jax.Array], jax.Array], rows: int = ROWS) -> jax.Array:
    """Combine the entries k, k + N / rows, k + 2 N / rows, ... with `op` into entry k: [..., N] to [..., N / rows]."""
    folded = values.reshape(*values.shape[:-1], rows, values.shape[-1] // rows)
    return functools.reduce(op, rows_of(folded))


def argmax(values: jax.Array) -> jax.Array:
    """Return `values.argmax(axis=-1)` as int32, for any length > 0; the index may be that of any largest entry."""
    index = jnp.broadcast_to(jnp.arange(values.shape[-1], dtype=jnp.int32), values.shape)
    while values.shape[-1] > _PLAIN_LENGTH and values.shape[-1] % 2 == 0:
        half = values.shape[-1] // 2
        (first, second), indices = (jax.lax.split(each, (half, half), axis=each.ndim - 1) for each in (values, index))
        index = jax.lax.select(jax.lax.ge(first, second), *indices)
        values = larger(first, second)
    best = jnp.argmax(values, axis=-1)[..., None]
    return jnp.take_along_axis(index, best, axis=-1)[..., 0]


def support_points(points: jax.Array) -> jax.Array:
    """Return the extreme points of a centred cloud in 66 directions.

    The directions are evenly spaced after scaling the cloud to unit variance along its principal axes, so that flat and
    long clouds get as many different vertices as round ones.

    Args:
        points: [3, N] float32 in the principal frame, mean zero; padding lies at the origin, inside the convex hull. N
            is a multiple of 16.

    Returns:
        [3, 66] float32; points may repeat.
    """
    folded = points.reshape(3, ROWS, -1)
    rows = rows_of(folded)
    spread = jnp.sqrt(functools.reduce(jnp.add, [row * row for row in rows]).sum(axis=-1))
    half = jnp.asarray(_DIRECTIONS) / jnp.where(spread > 0, spread, 1)

    # First find the best point index modulo N / 16, then the best of the 16 points with this residue.
    each = [rotate(half, row) for row in rows]
    residue = argmax(jnp.concatenate([functools.reduce(larger, each), -functools.reduce(smaller, each)]))
    candidates = jnp.swapaxes(folded, 1, 2)[:, residue]
    row = argmax(rotate(jnp.concatenate([half, -half]), candidates))
    return points[:, row * folded.shape[2] + residue]


def rotate(axes: jax.Array, points: jax.Array) -> jax.Array:
    """Return the coordinates [K, N] of `points`, [3, N] or one set for each axis [3, K, N], along `axes` [K, 3]."""
    # Explicit sums are float32 on every device and faster than a matmul with a side of 3. They fuse with a reduction,
    # which then stores no [K, N] array.
    columns = (jax.lax.slice_in_dim(axes, k, k + 1, axis=1) for k in range(3))
    each = (jax.lax.index_in_dim(points, k, keepdims=False) for k in range(3))
    return functools.reduce(jnp.add, [column * coordinate for column, coordinate in zip(columns, each, strict=True)])


def _eigenvectors(moments: jax.Array) -> jax.Array:
    """Return the eigenvectors of a symmetric [3, 3] as rows, largest eigenvalue first."""
    return jnp.linalg.eigh(moments)[1].T[::-1]


def _moments(points: jax.Array) -> jax.Array:
    """Return `points @ points.T` [3, 3] of centred points [3, N]; N is a multiple of 16."""
    # Row by row, because XLA would store whole coordinates, chosen for each product, and their products first.
    first, second = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])
    products = [row[first] * row[second] for row in rows_of(points.reshape(3, ROWS, -1))]
    return functools.reduce(jnp.add, products).sum(axis=-1)[np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]


def _rectangle_areas(xy: jax.Array, angles: jax.Array) -> jax.Array:
    """Return the areas [A] of the bounding rectangles of `xy` [2, M] rotated by `angles` [A]; M is a multiple of 16."""
    c, s = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    u, v = c * xy[0] + s * xy[1], c * xy[1] - s * xy[0]
    rows = xy.shape[1] // LANES
    # One reduction for all four extremes computes the rotated points only once.
    bounds = jnp.stack([fold(u, larger, rows), -fold(u, smaller, rows), fold(v, larger, rows), -fold(v, smaller, rows)])
    right, left, top, bottom = bounds.max(axis=-1)
    return (right + left) * (top + bottom)


def _minimum_area_angle(xy: jax.Array) -> jax.Array:
    """Return the angle of the minimum-area rectangle of `xy` [2, M], radians, at most about an eighth turn."""
    step = np.pi / 2 / COARSE_ANGLES
    best = jnp.zeros((), xy.dtype)
    # The angles are symmetric about 0, so that the result only changes its sign if an axis does. They exclude eighth
    # turns, since results a quarter turn apart would exchange two axes.
    offsets = (np.arange(COARSE_ANGLES) - COARSE_ANGLES // 2) * step
    for _ in range(3):
        angles = best + jnp.asarray(offsets, xy.dtype)
        best = angles[jnp.argmin(_rectangle_areas(xy, angles))]
        offsets, step = np.linspace(-step, step, 9), step / 4
    return best


def _sweep(axes: jax.Array, support: jax.Array) -> jax.Array:
    """Rotate two of `axes` [3, 3] about the last one, to the minimum-area rectangle of `support` [3, M]."""
    angle = _minimum_area_angle(rotate(axes, support)[:2])
    c, s = jnp.cos(angle), jnp.sin(angle)
    # The cyclic shift moves the next axis to the last row, about which the next rotation is made.
    return jnp.stack([c * axes[1] - s * axes[0], axes[2], c * axes[0] + s * axes[1]])


def minimal_box(points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the axes of an approximately minimal-volume oriented box, longest side first, and its bounds.

    The search starts from the principal axes of all points and from those of the support points (the released code uses
    the vertices of the convex hull), and the smaller box is returned. No gradient flows through the axes.

    Args:
        points: [3, N] float32, mean zero, padding at the origin; N is a multiple of 16.

    Returns:
        Axes [3, 3] float32, orthonormal rows with arbitrary signs, and smallest [3] and largest [3] coordinate along
        each axis.
    """
    points = jax.lax.stop_gradient(points)
    frame = _eigenvectors(_moments(points))
    principal = rotate(frame, points)
    support = support_points(principal)
    centred = support - support.mean(axis=1, keepdims=True)
    support_axes = _eigenvectors(matmul(centred, centred.T))
    support = jnp.pad(support, ((0, 0), (0, -support.shape[1] % LANES)), mode="edge")
    starts = jnp.stack([jnp.eye(3, dtype=points.dtype), support_axes])
    # With the loop inside `vmap`, it would be traced twice.
    candidates = jax.lax.fori_loop(0, SWEEPS, lambda _, axes: jax.vmap(_sweep, (0, None))(axes, support), starts)
    rotated = jax.vmap(rotate, (0, None))(candidates, support)
    volumes = jnp.prod(rotated.max(axis=2) - rotated.min(axis=2), axis=1)
    axes = candidates[jnp.argmin(volumes)]
    rotated = rotate(axes, principal)
    low, high = rotated.min(axis=1), rotated.max(axis=1)
    order = jnp.argsort(low - high)
    return matmul(axes[order], frame), low[order], high[order]


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
    return jnp.where(mask, points - low[:, None], 0), matmul(rotation, camera) - low


class Normalization(NamedTuple):
    """The rotation of the view normalization of one cloud, and the cloud before this rotation.

    Attributes:
        rotation: [3, 3], axes of the minimal box with their signs as rows, the longest side first.
        end_is_occluded: [] bool, whether the occlusion boundary decides which end along x comes first.
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
    camera_z = matmul(axes[2], camera) - middle[2]
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

    1. Rotate the cloud to the axes of an approximately minimal-volume box, longest side along x (`minimal_box`).
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
    turned = matmul(_about_y(alpha), rotation)
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

    Raises InputError as `view_normalize` and `turn`.
    """
    return _normalized_and_turned(clouds, *_sigma_s_and_alpha(config, parameters))


@functools.partial(jax.jit, static_argnums=1)
def mirror(normal: PointClouds, axes: str) -> PointClouds:
    """Mirror normalized clouds within their boxes (paper, "Training": each view is also mirrored in x, y and xy).

    Args:
        normal: clouds in the first octant.
        axes: axes to mirror, letters of "xyz"; "" returns equal clouds. Static.

    Raises:
        InputError: `axes` has another letter, or `normal` is not a batch of clouds.
    """
    check_batch(normal)
    if not set(axes) <= set("xyz"):
        raise InputError(f"axes is {axes!r}; expected letters of 'xyz'")
    flip = jnp.array([letter in axes for letter in "xyz"])
    high = jnp.where(normal.mask[..., None], normal.points, 0).max(axis=1, keepdims=True)
    points = jnp.where(flip & normal.mask[..., None], high - normal.points, normal.points)
    camera = jnp.where(flip, high[:, 0] - normal.camera, normal.camera)
    return dataclasses.replace(normal, points=points, camera=camera)
