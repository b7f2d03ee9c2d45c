"""Approximate minimal-volume oriented bounding box of one masked cloud (paper, "View normalization"; O'Rourke 1985).

Seen along any of its axes, a minimal box is a minimum-area rectangle of the cloud's projection. The search alternates
that step: fix one axis, turn the other two to the minimum-area rectangle, go on to the next axis. It works on support
points (vertices of the convex hull in a fixed set of directions), so that only finding those depends on the number of
points.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["minimal_box_axes", "support_points"]

HIGHEST = jax.lax.Precision.HIGHEST
"""TF32 would lose three digits of a coordinate on recent GPUs."""

SWEEPS = 6
"""Minimum-area rectangles a start: twice about each axis. More did not shrink the boxes of real scans."""

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


def support_points(points: jax.Array, mask: jax.Array) -> jax.Array:
    """Indices of the extreme points of a centred cloud in 66 directions.

    The directions are spread evenly for the cloud scaled to unit variance along its principal axes: flat and long
    clouds get as many different vertices as round ones.

    Args:
        points: [N, 3] float32, in the principal frame, mean zero.
        mask: [N] bool.

    Returns:
        [66] int32, with repetitions; all 0 for an empty cloud.
    """
    spread = jnp.sqrt(jnp.where(mask[:, None], points**2, 0).sum(axis=0))
    scaled = points / jnp.where(spread > 0, spread, 1)
    # Explicit sums, not a matmul: the reductions below then read each product once, with no [K, N] array in between.
    d = jnp.asarray(_DIRECTIONS)
    projected = d[:, :1] * scaled[:, 0] + d[:, 1:2] * scaled[:, 1] + d[:, 2:] * scaled[:, 2]
    index = jnp.arange(points.shape[0], dtype=jnp.int32)

    def last_extreme(values: jax.Array) -> jax.Array:
        # Two plain reductions: an argmax is not vectorized on CPUs.
        values = jnp.where(mask, values, -jnp.inf)
        best = values.max(axis=1, keepdims=True)
        return jnp.where(mask & (values >= best), index, 0).max(axis=1)

    return jnp.concatenate([last_extreme(projected), last_extreme(-projected)])


def principal_axes(points: jax.Array, weights: jax.Array) -> jax.Array:
    """Rows: eigenvectors of the weighted covariance, largest eigenvalue first. [3, 3]."""
    total = jnp.maximum(weights.sum(), 1)
    centred = points - jnp.matmul(weights, points, precision=HIGHEST) / total
    covariance = jnp.matmul((centred * weights[:, None]).T, centred, precision=HIGHEST) / total
    return jnp.linalg.eigh(covariance)[1].T[::-1]


def _rectangle_areas(xy: jax.Array, angles: jax.Array) -> jax.Array:
    """Areas [A] of the bounding rectangles of `xy` [M, 2] turned by `angles` [A]."""
    c, s = jnp.cos(angles)[:, None], jnp.sin(angles)[:, None]
    u, v = c * xy[:, 0] + s * xy[:, 1], c * xy[:, 1] - s * xy[:, 0]
    return (u.max(axis=1) - u.min(axis=1)) * (v.max(axis=1) - v.min(axis=1))


def _minimum_area_angle(xy: jax.Array) -> jax.Array:
    """Angle in radians, within about an eighth turn either way, of the minimum-area rectangle of `xy` [M, 2]."""
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

    Returns axes [3, 3] (rows) and the volume over `support` [M, 3].
    """

    def sweep(_: int, axes: jax.Array) -> jax.Array:
        turned = jnp.matmul(support, axes.T, precision=HIGHEST)
        angle = _minimum_area_angle(turned[:, :2])
        c, s = jnp.cos(angle), jnp.sin(angle)
        # The cyclic shift of the rows brings the next axis into the last place, where the turn leaves it fixed.
        return jnp.stack([c * axes[1] - s * axes[0], axes[2], c * axes[0] + s * axes[1]])

    axes = jax.lax.fori_loop(0, SWEEPS, sweep, axes)
    turned = jnp.matmul(support, axes.T, precision=HIGHEST)
    return axes, jnp.prod(turned.max(axis=0) - turned.min(axis=0))


def minimal_box_axes(points: jax.Array, mask: jax.Array) -> jax.Array:
    """Axes of an approximately minimal-volume oriented box: rows of a rotation, longest side first, signs arbitrary.

    Two starts, the principal axes of all points and those of the support points (as of the hull's vertices, which is
    the released rule); the smaller box wins. No gradient flows through the axes: they jump where another face becomes
    flush.

    Args:
        points: [N, 3] float32, mean zero over the mask.
        mask: [N] bool.

    Returns:
        [3, 3] float32, orthonormal.
    """
    points, weights = jax.lax.stop_gradient(points), mask.astype(points.dtype)
    frame = principal_axes(points, weights)
    principal = jnp.matmul(points, frame.T, precision=HIGHEST)
    support = principal[support_points(principal, mask)]
    starts = jnp.stack([jnp.eye(3, dtype=points.dtype), principal_axes(support, jnp.ones(len(support), points.dtype))])
    found, volumes = jax.vmap(lambda start: _search(support, start))(starts)
    axes = found[jnp.argmin(volumes)]
    turned = jnp.matmul(principal, axes.T, precision=HIGHEST)
    low = jnp.where(mask[:, None], turned, jnp.inf).min(axis=0)
    high = jnp.where(mask[:, None], turned, -jnp.inf).max(axis=0)
    return jnp.matmul(axes[jnp.argsort(low - high)], frame, precision=HIGHEST)
