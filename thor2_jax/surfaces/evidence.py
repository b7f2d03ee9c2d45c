"""Evidence of surfaces: how well the points of an instance fit the surface and the colours of a class.

>>> surfaces = surfaces_of(meshes)                             # training.objects.surfaces  # doctest: +SKIP
>>> with_evidence(embedding.class_probabilities(oriented), surfaces, sample_points(clouds))  # doctest: +SKIP

A rigid pose of the class is searched for. The candidates are view directions, turns about the line of sight and
anchors: the centroid of the visible part, or a corner of its box, coincides with that of the instance. The search goes
through stages: in each one, the best poses are kept, more points are compared, and steps of the point-to-plane ICP
algorithm (Chen and Medioni, 1992) refine what is kept. Nearest points are looked up in a grid. Nothing is random,
and all shapes are static.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.descriptor.slicing import to_lab
from thor2_jax.surfaces.surfaces import FAR, GRID, N_POINTS, RADIUS, Surfaces, rotations
from thor2_jax.types import PointClouds, matmul

__all__ = [
    "Sample",
    "compile_comparison",
    "fit_poses",
    "sample_points",
    "search_poses",
    "with_evidence",
    "with_evidence_on_host",
]

SAMPLED = 256
"""Points of an instance that are compared in the end; the stages use the first ones of them."""

LARGEST = 512
"""Largest number of points of an instance that are used; they smooth its colours and determine its roughness."""

STAGES = ((16, 96, 0), (64, 32, 3), (64, 8, 6))
"""Points that score the poses, poses that are kept, and steps of their refinement, for each stage of the search."""

PLACED, CLEAR, FREE_COST = 512, 0.02, 2.0
"""PLACED: points of a surface that are compared with what the camera sees around the instance. CLEAR: a point is in
free space if it is nearer to the camera by this distance, metres. FREE_COST: energy of a pose whose surface is wholly
in free space."""

REACH = 0.012
"""Largest distance of a match in scores and values, metres."""

NEAR, SCALE, REFINEMENTS = 0.008, 0.002, 8
"""NEAR: distance, metres, beyond which points do not count in the last steps of a refinement. SCALE: point-to-plane
distance, metres, at which points have half of the weight in `fit_poses`. REFINEMENTS: number of steps there."""

SYSTEMATIC, SMALLEST = 0.08, 0.01
"""SYSTEMATIC: errors of meshes, poses and depth, which the roughness of an instance does not contain, divided by its
size: the root mean square distance of its points from their centroid. SMALLEST: least size that is used, metres."""

N_COMPARED, GOOD_FIT, NAME_WEIGHTS = 5, 1.5, np.array([-21, 2.7, 1.5, 0], np.float32)
KNOWN_WEIGHTS, KNOWN_BIAS = np.array([-11.2, 1.5, 1, -15], np.float32), np.float32(2.55)
EXPONENT = np.float32(0.5)
"""See `with_evidence`; the weights are in the order of `search_poses`. The values are from real frames, seen through
random simulated cameras, since the probabilities of the networks and the noise of depth depend on the camera."""


class Sample(NamedTuple):
    """What is compared of instances, from `sample_points`.

    Attributes:
        points: [B, SAMPLED, 3], metres, relative to the camera.
        lab: [B, 3, SAMPLED], smoothed L*a*b* colours.
        rough: [B], roughness, metres.
        rim: [B, SAMPLED] bool, see `PointClouds.rim`.
        around: [B, A, A, 3], see `PointClouds.around`.
        is_skipped: [B] bool: no points, or not compared.
    """

    points: jax.Array
    lab: jax.Array
    rough: jax.Array
    rim: jax.Array
    around: jax.Array
    is_skipped: jax.Array


def fit_poses(surfaces: Surfaces, clouds: PointClouds, class_index: ArrayLike) -> jax.Array:
    """Return the poses [B, 3, 4] of instances: a rotation and a shift from the camera to the class, metres.

    The pose of the search is refined by steps of the ICP algorithm with Cauchy weights and all points that are within
    `NEAR` of the surface. The pose of an empty cloud is zero.

    Args:
        surfaces: surfaces of the classes.
        clouds: as `sample_points` takes them.
        class_index: [B] int.
    """
    index = jnp.asarray(class_index)
    return _refined_poses(surfaces, clouds, index, search_poses(surfaces, sample_points(clouds), index)[1])


@jax.jit
def _refined_poses(surfaces: Surfaces, clouds: PointClouds, class_index: jax.Array, poses: jax.Array) -> jax.Array:
    def refine(row: tuple[jax.Array, ...]) -> jax.Array:
        points, mask, camera, index, pose = row
        surface, points = jax.tree.map(lambda field: field[index], surfaces), _homogeneous(points - camera)

        def weigh(distance: jax.Array, residual: jax.Array) -> jax.Array:
            return mask * (distance < NEAR) / (1 + jnp.square(residual / SCALE))

        return jax.lax.fori_loop(0, REFINEMENTS, lambda _, p: _refined(surface, p, points, weigh), pose[None])[0]

    return jax.lax.map(refine, (clouds.points, clouds.mask, clouds.camera, class_index, poses))


@functools.partial(jax.jit, static_argnames="size")
def with_evidence(
    probabilities: jax.Array, surfaces: Surfaces, samples: Sample, first: int = 0, size: int | None = None
) -> jax.Array:
    """Return class probabilities [B, C] of an embedding, changed by the evidence e of the most probable classes.

    Up to `N_COMPARED` classes are compared, in the order of their probabilities p, until the next one is unlikely to
    come first: p^`EXPONENT` exp(`GOOD_FIT`) is less than the largest p^`EXPONENT` exp(`NAME_WEIGHTS` e) so far. The
    compared classes share their total probability in proportion to p^`EXPONENT` exp(`NAME_WEIGHTS` e). The odds o of
    all classes against the distractors then become s o^`EXPONENT` exp(`KNOWN_WEIGHTS` e + `KNOWN_BIAS`) for the class
    that is then most probable: s is its fraction of the total probability of all classes, and e its evidence.

    With a `size`, this number of rows is changed and returned, from row `first` on.
    """
    if size is not None:
        rows = probabilities, samples
        probabilities, samples = jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, first, size), rows)
    largest, index = jax.lax.top_k(probabilities, min(N_COMPARED, probabilities.shape[1]))  # [B, K]
    logits = EXPONENT * jnp.log(jnp.maximum(largest, 1e-30))

    def compare(best: jax.Array, name: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        probability, logit, index = name
        is_compared = (probability > 0) & (logit + GOOD_FIT >= best)
        values, _ = search_poses(surfaces, samples._replace(is_skipped=samples.is_skipped | ~is_compared), index)
        return jnp.maximum(best, logit + matmul(values, NAME_WEIGHTS)), (is_compared, values)

    _, results = jax.lax.scan(compare, jnp.full_like(logits[:, 0], -jnp.inf), (largest.T, logits.T, index.T))
    is_compared, values = (each.swapaxes(0, 1) for each in results)  # [B, K], [B, K, 4]
    changed, factor = _probabilities_with(largest, probabilities.sum(axis=1), is_compared, values)
    return jnp.put_along_axis(probabilities, index, changed, axis=1, inplace=False) * factor[:, None]


@jax.jit
def sample_points(clouds: PointClouds) -> Sample:
    """Return what is compared of clouds.

    Args:
        clouds: [B, N] clouds in metres, in any frame (with `around`: in the camera frame); padding follows the points.
    """

    def sample(row: tuple[jax.Array, ...]) -> Sample:
        points, colors, mask, rim, camera, around = row
        number, count = jnp.arange(min(len(points), LARGEST)), mask.sum()
        # The order of the points is spatial. Equal steps through it, and multiples of the golden ratio, spread evenly.
        index = (number * jnp.maximum(count / len(number), 1)).astype(int)
        points, lab = points[index] - camera, to_lab(colors[index])
        golden = np.arange(1, SAMPLED + 1) * (5**0.5 - 1) / 2 % 1
        chosen = (golden.astype(np.float32) * jnp.minimum(count, len(number))).astype(int)
        described = _describe_neighbourhoods(points[chosen], points, lab, number < count)
        return Sample(points[chosen], *described, rim[index][chosen], around, count == 0)

    around = jnp.zeros((len(clouds.points), 1, 1, 3), jnp.float32) if clouds.around is None else clouds.around
    rim = jnp.zeros(clouds.mask.shape, bool) if clouds.rim is None else clouds.rim
    fields = clouds.points, clouds.colors, clouds.mask, rim, clouds.camera, around
    return jax.lax.map(sample, fields, batch_size=16)


@jax.jit
def search_poses(surfaces: Surfaces, samples: Sample, class_index: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return how well each instance fits a class.

    Args:
        surfaces: surfaces of the classes.
        samples: what is compared of B instances.
        class_index: [B] int.

    Returns:
        The evidence [B, 4] float32 and the poses [B, 3, 4] of the search, zeros for an empty cloud. The evidence is the
        logarithm of the mean point-to-plane distance divided by the roughness of the instance (both plus `SYSTEMATIC`
        times its size), the correlations of chroma and of lightness, and the fraction of the surface in free space.
    """

    def fit(sample: Sample, index: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _fit(jax.tree.map(lambda field: field[index], surfaces), sample)

    nothing = jnp.zeros(4, jnp.float32), jnp.zeros((3, 4), jnp.float32)

    def of_row(row: tuple[Sample, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jax.lax.cond(row[0].is_skipped, lambda *_: nothing, fit, *row)

    if jax.default_backend() != "cpu":
        return jax.vmap(of_row)((samples, class_index))
    return jax.lax.map(of_row, (samples, class_index))  # one by one, so that padding can be skipped


def with_evidence_on_host(
    probabilities: NDArray[np.floating], surfaces: Sequence[Surfaces], samples: Sample
) -> NDArray[np.floating]:
    """Return probabilities [B, n] on the host, changed as by `with_evidence`, for n surfaces of one class each.

    Every instance and name is compared on its own, so that other numbers of instances and names compile nothing.
    """
    probabilities = np.pad(probabilities, ((0, 0), (0, max(N_COMPARED - len(surfaces), 0))))
    index = np.argsort(-probabilities, axis=1, kind="stable")[:, :N_COMPARED]
    largest = np.take_along_axis(probabilities, index, axis=1)
    logits = EXPONENT * np.log(np.maximum(largest, 1e-30))
    is_compared, values = np.zeros(index.shape, bool), np.zeros((*index.shape, 4), np.float32)
    alone = [jax.tree.map(lambda a, row=row: a[row : row + 1], samples) for row in range(len(index))]
    best = np.full(len(index), -np.inf)
    for k in range(N_COMPARED):
        is_compared[:, k] = (largest[:, k] > 0) & (logits[:, k] + GOOD_FIT >= best)
        rows = np.flatnonzero(is_compared[:, k])
        # All are dispatched before the first result is awaited.
        fits = [search_poses(surfaces[index[row, k]], alone[row], np.zeros(1, int))[0] for row in rows]
        values[rows, k] = np.concatenate([values[:0, k], *fits])
        best[rows] = np.maximum(best[rows], logits[rows, k] + values[rows, k] @ NAME_WEIGHTS)
    arguments = largest, probabilities.sum(axis=1), is_compared, values
    for row in range(len(probabilities)):
        shares, factor = map(np.asarray, _probabilities_with(*(jnp.asarray(each[row : row + 1]) for each in arguments)))
        probabilities[row, index[row]] = shares[0]
        probabilities[row] *= factor[0]
    return probabilities[:, : len(surfaces)]


def compile_comparison(samples: Sample) -> None:
    """Compile the programs of `with_evidence_on_host`, which do not depend on the number of instances and names."""
    with_evidence_on_host(np.ones((1, 1)) / 2, [Surfaces.empty()], jax.tree.map(lambda a: np.asarray(a)[:1], samples))


@jax.jit
def _probabilities_with(
    largest: jax.Array, total: jax.Array, is_compared: jax.Array, values: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the probabilities [B, K] with the evidence, and a factor [B] of all probabilities.

    Args:
        largest: [B, K], the largest probabilities.
        total: [B], sums of all probabilities.
        is_compared: [B, K] bool.
        values: [B, K, 4], their evidence.
    """
    logits = EXPONENT * jnp.log(jnp.maximum(largest, 1e-30)) + matmul(values, NAME_WEIGHTS)
    shares = jax.nn.softmax(jnp.where(is_compared, logits, -jnp.inf), axis=1)
    changed = jnp.where(is_compared, shares * (largest * is_compared).sum(axis=1, keepdims=True), largest)
    best = jnp.take_along_axis(values, changed.argmax(axis=1)[:, None, None], axis=1)[:, 0]
    known, share = total.clip(1e-4, 1 - 1e-4), changed.max(axis=1) / jnp.maximum(total, 1e-30)
    logit = EXPONENT * jnp.log(known / (1 - known)) + matmul(best, KNOWN_WEIGHTS) + KNOWN_BIAS
    logit += jnp.log(jnp.maximum(share, 1e-30))
    return changed, jax.nn.sigmoid(logit) / jnp.maximum(total, 1e-30)


def _describe_neighbourhoods(
    chosen: jax.Array, points: jax.Array, lab: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return smoothed colours [3, n] of chosen points [n, 3], and the roughness of the instance in metres.

    The roughness is the median distance of neighbours from their plane. Points with fewer than eight neighbours do not
    count, nor do neighbours within 0.1 mm of their plane: depth in coarse steps is flat. Without any, it is 1 mm.
    """
    here, every = chosen - chosen.mean(axis=0), jnp.where(mask[:, None], points - chosen.mean(axis=0), 10)
    squared = jnp.square(here).sum(axis=1)[:, None] + jnp.square(every).sum(axis=1) - 2 * matmul(here, every.T)
    products = (every[:, :, None] * every[:, None]).reshape(-1, 9)
    columns = jnp.concatenate([jnp.ones_like(lab[:, :1]), lab, every, products], axis=1)
    sums = matmul((squared < RADIUS**2).astype(jnp.float32), columns)
    count, means = sums[:, 0], sums[:, 1:] / jnp.maximum(sums[:, :1], 1)
    spread = means[:, 6:].reshape(-1, 3, 3) - means[:, 3:6, None] * means[:, None, 3:6]
    cofactors = jnp.stack([jnp.cross(spread[:, k - 2], spread[:, k - 1]) for k in range(3)], axis=1)
    # The smallest eigenvalue is close to one divided by the trace of the inverse.
    variance = (spread[:, 0] * cofactors[:, 0]).sum(axis=1) / jnp.trace(cofactors, axis1=1, axis2=2)
    deviation = jnp.sqrt(jnp.maximum(variance, 0))
    deviation = jnp.where((count >= 8) & (deviation > 1e-4), deviation, jnp.nan)
    return means[:, :3].T, jnp.nan_to_num(jnp.nanmedian(deviation), nan=1e-3)


def _fit(surface: Surfaces, sample: Sample) -> tuple[jax.Array, jax.Array]:
    """Return the evidence [4] and the pose [3, 4] of one instance for one class."""
    points, lab = _homogeneous(sample.points), sample.lab

    def energy(pose: jax.Array, n: int) -> jax.Array:
        """Return the energies [K] of poses from distances and colours; a shift of all colours is tolerated."""
        _, distance, color = _look_up(surface, matmul(pose, points[:, :n]), (3, 4, 5))
        matched = distance < REACH
        differ = lab[:, :n] - color
        total = matmul(differ, matched[..., None].astype(jnp.float32))[..., 0]
        shift = total / jnp.maximum(matched.sum(axis=1, keepdims=True), 1)
        limit = np.array([30, 18, 18], np.float32)  # larger differences of L*, a*, b* are not due to the illumination
        rest = (differ - shift.clip(-limit, limit)[..., None]) * np.array([[0.4], [1], [1]], np.float32)
        cost = jnp.minimum(jnp.sqrt(jnp.square(rest).sum(axis=1)) / 30, 1)
        return (jnp.minimum(distance / REACH, 1) + 0.6 * jnp.where(matched, cost, 1)).mean(axis=1)

    def refine(step: jax.Array, pose: jax.Array, n: int) -> jax.Array:
        limit = jnp.maximum(FAR - 0.002 * step, NEAR)
        return _refined(surface, pose, points[:, :n], lambda distance, _: (distance < limit).astype(jnp.float32))

    def in_free_space(pose: jax.Array) -> jax.Array:
        """Return the fraction [K] of the surface that poses place in front of what the camera sees."""
        here = matmul(pose[..., :3].mT, surface.table[:3, :: N_POINTS // PLACED] - pose[..., 3:])  # [K, 3, PLACED]
        low, high, last = sample.around[0, 0, :2], sample.around[-1, -1, :2], len(sample.around) - 1
        at = (here[:, :2] / here[:, 2:] - low[:, None]) / jnp.maximum(high - low, 1e-9)[:, None] * last
        column, row = jnp.moveaxis(jnp.rint(at).clip(-1, last + 1).astype(int), 1, 0)
        is_inside = (column >= 0) & (column <= last) & (row >= 0) & (row <= last)
        seen = jnp.take(sample.around[..., 2].ravel(), row * (last + 1) + column, mode="clip")
        is_free = is_inside & (here[:, 2] > 0) & (here[:, 2] < seen - CLEAR)
        return is_free.mean(axis=1, dtype=jnp.float32)

    pose, done = _candidates(surface.boxes, sample.points), 0
    for n, kept, steps in STAGES:
        pose = pose[jax.lax.top_k(-energy(pose, n), kept)[1]]
        if steps:
            pose = jax.lax.fori_loop(done, done + steps, functools.partial(refine, n=n), pose)
        done += steps
    free = in_free_space(pose)
    best = (energy(pose, SAMPLED) + FREE_COST * free).argmin()
    offset, distance, entries = (each[0] for each in _look_up(surface, matmul(pose[best, None], points), range(3, 9)))
    matched = distance < REACH
    plane = jnp.where(matched, jnp.abs((offset * entries[3:]).sum(axis=0)), REACH)
    counted = matched | ~sample.rim  # masks may be too large
    plane = plane.mean(where=counted | ~counted.any())
    chroma, lightness = (_correlation(lab[k], entries[k], matched) for k in (np.s_[1:3], np.s_[:1]))
    error = SYSTEMATIC * jnp.maximum(jnp.linalg.norm(sample.points.std(axis=0)), SMALLEST)
    fit = jnp.log((plane + error) / (sample.rough + error))
    return jnp.stack([fit, chroma, lightness, free[best]]), pose[best]


def _homogeneous(points: jax.Array) -> jax.Array:
    """Return points [n, 3] as columns [4, n] that poses can be multiplied with."""
    return jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1).T


def _look_up(surface: Surfaces, q: jax.Array, rows: Sequence[int]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return offsets [K, 3, n] and distances [K, n] of points [K, 3, n], and rows of the table."""
    at = ((q - surface.grid[0, :, None]) / surface.grid[1, :, None]).clip(0, GRID - 1).astype(int)
    nearest = jnp.take(surface.nearest, (at[:, 0] * GRID + at[:, 1]) * GRID + at[:, 2], mode="clip").astype(int)
    # XLA gathers single numbers on CPUs ten times as fast as rows.
    entries = jnp.stack([jnp.take(surface.table[k], nearest, mode="clip") for k in (0, 1, 2, *rows)], axis=1)
    offset = q - entries[:, :3]
    return offset, jnp.linalg.norm(offset, axis=1), entries[:, 3:]


def _refined(
    surface: Surfaces, pose: jax.Array, points: jax.Array, weigh: Callable[[jax.Array, jax.Array], jax.Array]
) -> jax.Array:
    """Return poses [K, 3, 4] after one step of the point-to-plane ICP algorithm.

    Args:
        surface: surface of one class.
        pose: [K, 3, 4], poses before the step.
        points: [4, n], see `_homogeneous`.
        weigh: function from the distances and the point-to-plane distances [K, n] of the points to their weights.
    """
    q = matmul(pose, points)
    offset, distance, normal = _look_up(surface, q, (6, 7, 8))
    residual = (offset * normal).sum(axis=1, keepdims=True)
    rows = jnp.concatenate([jnp.cross(q, normal, axis=1), normal, -residual], axis=1)
    weight = weigh(distance, residual[:, 0])[:, None]
    system = matmul(rows[:, :6] * weight, rows.mT) + 1e-3 * np.eye(6, 7, dtype=np.float32)
    for k in range(6):  # Gauss-Jordan elimination; the matrix is positive definite
        row = system[:, k] / system[:, k, k, None]
        system = (system - system[:, :, k, None] * row[:, None]).at[:, k].set(row)
    turn = _rotation(system[:, :3, 6])
    return matmul(turn, pose).at[..., 3].add(system[:, 3:, 6])


def _candidates(boxes: jax.Array, points: jax.Array) -> jax.Array:
    """Return poses [5 * R, 3, 4], rotations and shifts from the camera to a class, for its boxes and points [n, 3]."""
    x, y, z = points.mean(axis=0) / jnp.maximum(jnp.linalg.norm(points.mean(axis=0)), 1e-6)
    c = 1 / jnp.maximum(1 + z, 1e-6)
    ahead = jnp.array([[1 - c * x * x, -c * x * y, -x], [-c * x * y, 1 - c * y * y, -y], [x, y, z]])  # to the z axis
    seen = matmul(points, ahead.T)
    low, high = jnp.sort(seen.T, axis=1)[:, np.array([5, -6])].T  # without the outermost points
    low, middle, high = low - boxes[:, 0], seen.mean(axis=0) - boxes[:, 1], high - boxes[:, 2]  # places of the class
    corners = [jnp.stack([a[:, 0], b[:, 1], middle[:, 2]], axis=1) for a in (low, high) for b in (low, high)]
    inverse = jnp.asarray(rotations().mT)
    shifts = -matmul(inverse[:, None], jnp.stack([middle, *corners], axis=1)[..., None])  # [R, 5, 3, 1]
    turns = jnp.broadcast_to(matmul(inverse, ahead)[:, None], (*shifts.shape[:2], 3, 3))
    return jnp.concatenate([turns, shifts], axis=3).reshape(-1, 3, 4)


def _rotation(vector: jax.Array) -> jax.Array:
    """Return the rotations [K, 3, 3] of rotation vectors [K, 3]; JAX's own have products in TF32 on GPUs."""
    angle = jnp.maximum(jnp.linalg.norm(vector, axis=-1), 1e-9)[:, None, None]
    cross = jnp.cross(vector[:, None], jnp.eye(3, dtype=vector.dtype)).mT / angle
    return jnp.eye(3, dtype=vector.dtype) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * matmul(cross, cross)


def _correlation(first: jax.Array, second: jax.Array, matched: jax.Array) -> jax.Array:
    """Return the correlation of colours [c, n] over matched points [n]; lower without contrast."""
    count = jnp.maximum(matched.sum(), 1)
    first, second = ((each - (each * matched).sum(axis=1, keepdims=True) / count) * matched for each in (first, second))
    return (first * second).sum() / jnp.sqrt(jnp.square(first).sum() * jnp.square(second).sum() + 100 * count)
