"""Approximate minimal-volume oriented bounding box of one masked cloud (paper, "View normalization"; O'Rourke 1985).

Seen along any of its axes, a minimal box is a minimum-area rectangle of the cloud's projection. The search alternates
that step: fix one axis, turn the other two to the minimum-area rectangle, go on to the next axis. It works on support
points (vertices of the convex hull in a fixed set of directions), so that only finding those depends on the number of
points.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from thor2_jax.descriptor.reductions import ROWS, argmax, fold, larger, largest, smaller, smallest

__all__ = ["minimal_box", "rotate", "support_points"]

HIGHEST = jax.lax.Precision.HIGHEST
"""TF32 would lose three digits of a coordinate on recent GPUs."""

SWEEPS = 6
"""Minimum-area rectangles a start: twice about each axis. More did not shrink the boxes of real scans."""

LANES = 16
"""Support points turned at a time."""

COARSE = 17
"""Angles tried over a quarter turn; two finer rounds of 9 around the best leave a step of 0.33 degrees."""


def _half_sphere(n: int = 4) -> np.ndarray:
    """[33, 3] float32 unit vectors, no two opposite: integer points with |i| + |j| + |k| = n.

    Closed under sign flips of the axes: the frame of a covariance is known only up to those, and the box must not
    depend on them.
    """
    chosen: list[tuple[int, ...]] = []
    for point in itertools.product(range(-n, n + 1), repeat=3):
        if sum(map(abs, point)) == n and tuple(-a for a in point) not in chosen:
            chosen.append(point)
    directions = np.array(chosen, np.float64)
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


_DIRECTIONS = _half_sphere()


def support_points(points: jax.Array) -> jax.Array:
    """The extreme points of a centred cloud in 66 directions.

    The directions are spread evenly for the cloud scaled to unit variance along its principal axes: flat and long
    clouds get as many different vertices as round ones.

    Args:
        points: [3, N] float32, in the principal frame, mean zero; padding at the origin, which is never beyond the
            cloud's hull. N is a multiple of 16.

    Returns:
        [3, 66] float32, with repetitions.
    """
    rows = points.reshape(3, ROWS, -1)
    spread = jnp.sqrt(functools.reduce(jnp.add, (rows[:, k] ** 2 for k in range(ROWS))).sum(axis=-1))
    half = jnp.asarray(_DIRECTIONS) / jnp.where(spread > 0, spread, 1)

    def along(d: jax.Array, rows: jax.Array) -> jax.Array:
        # Explicit sums, not a matmul: a reduction of them reads each product once, with no [K, N] array in between.
        return d[:, :1] * rows[0] + d[:, 1:2] * rows[1] + d[:, 2:] * rows[2]

    # First the best of all residues of a point's index modulo N / 16, then the best of the 16 points of that residue.
    each = [along(half, rows[:, k]) for k in range(ROWS)]
    extremes = [functools.reduce(larger, each), -functools.reduce(smaller, each)]
    residue = argmax(jnp.concatenate(extremes))
    candidates = jnp.swapaxes(rows, 1, 2)[:, residue]
    row = argmax(along(jnp.concatenate([half, -half]), candidates))
    return points[:, row * rows.shape[2] + residue]


def rotate(axes: jax.Array, points: jax.Array) -> jax.Array:
    """Coordinates [3, N] of `points` [3, N] along the rows of `axes` [3, 3]."""
    # Explicit sums: exact in float32 on every device, and faster than a product with a side of 3.
    return axes[:, :1] * points[0] + axes[:, 1:2] * points[1] + axes[:, 2:] * points[2]


def _eigenvectors(moments: jax.Array) -> jax.Array:
    """Rows: eigenvectors of a symmetric [3, 3], largest eigenvalue first."""
    return jnp.linalg.eigh(moments)[1].T[::-1]


def _moments(points: jax.Array) -> jax.Array:
    """[3, 3], sums of products of the coordinates of centred points [3, N], N a multiple of 16."""
    # Products of rows, not rows of products: those would all be stored first.
    rows = points.reshape(3, ROWS, -1)
    products = (rows[np.array([0, 0, 0, 1, 1, 2]), k] * rows[np.array([0, 1, 2, 1, 2, 2]), k] for k in range(ROWS))
    return functools.reduce(jnp.add, products).sum(axis=-1)[np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]


def _rectangle_areas(xy: jax.Array, angles: jax.Array) -> jax.Array:
    """Areas [A] of the bounding rectangles of `xy` [2, M] turned by `angles` [A]; M is a multiple of 16."""
    c, s = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    u, v = c * xy[0] + s * xy[1], c * xy[1] - s * xy[0]
    rows = xy.shape[1] // LANES
    # The four extremes in one reduction: the turned points are then made once, and sixteen at a time.
    ends = jnp.stack([fold(u, larger, rows), -fold(u, smaller, rows), fold(v, larger, rows), -fold(v, smaller, rows)])
    right, left, top, bottom = ends.max(axis=-1)
    return (right + left) * (top + bottom)


def _minimum_area_angle(xy: jax.Array) -> jax.Array:
    """Angle in radians, within about an eighth turn either way, of the minimum-area rectangle of `xy` [2, M]."""
    step = np.pi / 2 / COARSE
    best = jnp.zeros(())
    # An odd number of angles, symmetric about 0 and without the eighth turns: if the frame comes with another sign, the
    # angle found changes its sign and no more. A quarter turn apart, it would exchange the axes and the search's order.
    offsets = (np.arange(COARSE) - COARSE // 2) * step
    for _ in range(3):
        angles = best + jnp.asarray(offsets, jnp.float32)
        best = angles[jnp.argmin(_rectangle_areas(xy, angles))]
        offsets, step = np.linspace(-step, step, 9), step / 4
    return best


def _search(support: jax.Array, axes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Alternate minimum-area rectangles from a start.

    Returns axes [3, 3] (rows) and the volume over `support` [3, M], M a multiple of 16.
    """

    def sweep(_: int, axes: jax.Array) -> jax.Array:
        angle = _minimum_area_angle(rotate(axes, support)[:2])
        c, s = jnp.cos(angle), jnp.sin(angle)
        # The cyclic shift of the rows brings the next axis into the last place, where the turn leaves it fixed.
        return jnp.stack([c * axes[1] - s * axes[0], axes[2], c * axes[0] + s * axes[1]])

    axes = jax.lax.fori_loop(0, SWEEPS, sweep, axes)
    turned = rotate(axes, support)
    return axes, jnp.prod(turned.max(axis=1) - turned.min(axis=1))


def minimal_box(points: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """An approximately minimal-volume oriented box: its axes, longest side first, and the cloud's ends along them.

    Two starts, the principal axes of all points and those of the support points (as of the hull's vertices, which is
    the released rule); the smaller box wins. No gradient flows through the axes: they jump where another face becomes
    flush.

    Args:
        points: [3, N] float32, mean zero, padding at the origin; N is a multiple of 16.

    Returns:
        [3, 3] float32, orthonormal rows, their signs arbitrary; [3] least and [3] greatest coordinate along each.
    """
    points = jax.lax.stop_gradient(points)
    frame = _eigenvectors(_moments(points))
    principal = rotate(frame, points)
    support = support_points(principal)
    centred = support - support.mean(axis=1, keepdims=True)
    of_support = _eigenvectors(jnp.matmul(centred, centred.T, precision=HIGHEST))
    support = jnp.pad(support, ((0, 0), (0, -support.shape[1] % LANES)), mode="edge")
    starts = jnp.stack([jnp.eye(3, dtype=points.dtype), of_support])
    found, volumes = jax.vmap(lambda start: _search(support, start))(starts)
    axes = found[jnp.argmin(volumes)]
    turned = rotate(axes, principal)
    low, high = smallest(turned), largest(turned)
    order = jnp.argsort(low - high)
    return jnp.matmul(axes[order], frame, precision=HIGHEST), low[order], high[order]
