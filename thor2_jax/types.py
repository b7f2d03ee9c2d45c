"""Records passed between the stages of the pipeline, and learnable parameters, all as frozen pytrees of arrays.

Shapes use these letters: B clouds, N points of a cloud after padding, S slices, J strips of a slice, R colour regions,
P pixels along the side of an image. Compiled functions take the parameters as arguments, so that new values do not
cause a compilation:

>>> parameters = Parameters.of(network, config)                               # doctest: +SKIP
>>> loss = lambda p: (describe(clouds, network, config, p).tops2**2).sum()    # doctest: +SKIP
>>> jax.grad(loss)(parameters).image_variance                                 # doctest: +SKIP
"""

import dataclasses
from collections.abc import Sequence, Sized
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from colornet import ColorNetwork
from thor2_jax.capacity import POINT_BUCKETS, point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError, as_array, decoding

__all__ = [
    "HIGHEST",
    "Cloud",
    "Descriptors",
    "Diagrams",
    "Parameters",
    "PointClouds",
    "Strips",
    "check_batch",
    "check_capacity",
    "check_cloud",
    "check_types",
    "is_positive_integer",
    "matmul",
]

HIGHEST = jax.lax.Precision.HIGHEST
"""Precision of all products; TF32, the default of recent GPUs, would lose three digits."""

matmul = partial(jnp.matmul, precision=HIGHEST)

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""One point cloud of any size: xyz [n, 3] and sRGB [n, 3]."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class PointClouds:
    """A batch of coloured point clouds, padded to the same number of points.

    Attributes:
        points: [B, N, 3] float32; metres in the camera frame as input, scaled units after view normalization.
        colors: [B, N, 3] float32, sRGB in [0, 1].
        mask: [B, N] bool, False on padding.
        camera: [B, 3] float32, the camera's position in the frame of `points`.
        boundary: [B, N] bool, points on the occlusion boundary of the object; all False for unoccluded views.
        rim: [B, N] bool, points near the contour of the instance's mask (see `descriptor.looks`,
            `surfaces.evidence`); None if unknown.
        around: [B, G, G, 3] float32, what the camera sees around the instance, on a regular grid of rays: x / z, y / z
            and z in the camera frame, metres; z is 0 on the instance and without depth; None if unknown.
    """

    points: jax.Array
    colors: jax.Array
    mask: jax.Array
    camera: jax.Array
    boundary: jax.Array
    rim: jax.Array | None = None
    around: jax.Array | None = None

    @classmethod
    def pack(
        cls,
        clouds: Sequence[tuple[ArrayLike, ArrayLike]],
        capacity: int | None = None,
        camera: ArrayLike | None = None,
        boundary: Sequence[ArrayLike | None] | None = None,
        *,
        rim: Sequence[ArrayLike | None] | None = None,
        on_host: bool = False,
    ) -> "PointClouds":
        """Pad clouds of different sizes to the same number of points, and stack them.

        Args:
            clouds: pairs of xyz [n, 3], floating, metres, and rgb [n, 3], sRGB, uint8 or floating in [0, 1]. An empty
                cloud (n = 0) becomes padding only; its descriptor is zero.
            capacity: padded number of points N; by default the point bucket of the largest cloud, the smallest of
                `thor2_jax.capacity.POINT_BUCKETS` that holds it. Compiled functions are reused for equal N.
            camera: [3] or [B, 3], position of the camera; by default the origin.
            boundary: for each cloud an [n] bool array or None, the points on the occlusion boundary.
            rim: for each cloud an [n] bool array or None, the points near the contour of the instance's mask.
            on_host: keep the fields as NumPy arrays. A compiled function transfers them faster than `device_put`.

        Raises:
            InputError: `clouds` is empty, or has wrong shapes or types, coordinates that are not finite in float32, or
                colours out of range; a cloud exceeds `capacity` or the largest bucket; `capacity` is not a positive
                integer; `camera` is not finite or has another shape; `boundary` or `rim` does not fit the clouds. The
                message gives the index of the cloud.
        """
        if not isinstance(clouds, Sized) or len(clouds) == 0:
            actual = "empty" if isinstance(clouds, Sized) else f"of type {type(clouds).__name__}"
            raise InputError(f"clouds is {actual}; expected a list of at least one pair (xyz, rgb)")
        arrays = [check_cloud(pair, f"clouds[{i}]") for i, pair in enumerate(clouds)]
        sizes = [len(xyz) for xyz, _ in arrays]
        n = _padded_size(sizes, capacity)
        points = np.zeros((len(arrays), n, 3), np.float32)
        colors = np.zeros((len(arrays), n, 3), np.float32)
        for i, (xyz, rgb) in enumerate(arrays):
            points[i, : sizes[i]], colors[i, : sizes[i]] = xyz, rgb
        on_boundary = _padded_flags("boundary", [None] * len(arrays) if boundary is None else boundary, sizes, n)
        on_rim = None if rim is None else _padded_flags("rim", rim, sizes, n)
        position = _camera_positions((0, 0, 0) if camera is None else camera, len(arrays))
        mask = np.arange(n) < np.array(sizes)[:, None]
        fields: Any = points, colors, mask, position, on_boundary, on_rim
        return cls(*(fields if on_host else jax.device_put(fields)))

    def unpack(self) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Return the clouds without padding: pairs of points [n, 3], in the unit of `points`, and sRGB [n, 3]."""
        points, colors, mask = (np.asarray(array) for array in (self.points, self.colors, self.mask))
        return [(xyz[real], rgb[real]) for xyz, rgb, real in zip(points, colors, mask, strict=True)]


def _padded_flags(name: str, flags: Sequence[ArrayLike | None], sizes: list[int], n: int) -> NDArray[np.bool_]:
    if not isinstance(flags, Sized) or len(flags) != len(sizes):
        actual = f"has {len(flags)} entries" if isinstance(flags, Sized) else f"is of type {type(flags).__name__}"
        raise InputError(f"{name} {actual} for {len(sizes)} clouds; expected a list of one entry for each cloud")
    padded = np.zeros((len(sizes), n), bool)
    for i, (size, values) in enumerate(zip(sizes, flags, strict=True)):
        if values is not None:
            given = as_array(values, f"{name}[{i}]", "bool [n]")
            if given.shape != (size,) or given.dtype != bool:
                raise InputError(f"{name}[{i}] is {given.dtype} {list(given.shape)}; expected bool [{size}]")
            padded[i, :size] = given
    return padded


def _padded_size(sizes: list[int], capacity: int | None) -> int:
    check_capacity(capacity)
    largest, limit = max(sizes), capacity or POINT_BUCKETS[-1]
    if largest > limit:
        raise InputError(
            f"clouds[{sizes.index(largest)}] has {largest} points; expected at most {limit}, the "
            f"{'capacity' if capacity else 'largest bucket'}; downsample it or give a larger capacity"
        )
    return capacity or point_bucket(largest)


def _camera_positions(camera: ArrayLike, n_clouds: int) -> NDArray[np.float32]:
    given = as_array(camera, "camera", f"[3] or [{n_clouds}, 3]")
    with decoding("camera is not numeric", f"numbers, [3] or [{n_clouds}, 3]"):
        position = _as_float32(given.astype(np.float64))
    if position.shape not in ((3,), (n_clouds, 3)) or not np.isfinite(position).all():
        raise InputError(f"camera is {position.tolist()}; expected finite [3] or [{n_clouds}, 3]")
    return np.broadcast_to(position, (n_clouds, 3))


def _as_float32(values: NDArray[Any]) -> NDArray[np.float32]:
    """Convert to float32. Values that are too large become infinite without a warning; the caller refuses them."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def is_positive_integer(value: Any) -> bool:
    """Return whether a value is a positive integer of Python or NumPy; True is not."""
    return isinstance(value, int | np.integer) and value is not True and bool(value > 0)


def check_capacity(capacity: Any) -> None:
    """Raise InputError unless a padded number of points is None or a positive integer, also of NumPy."""
    if not (capacity is None or is_positive_integer(capacity)):
        raise InputError(f"capacity is {capacity!r}; expected a positive integer, or None for the point buckets")


def check_batch(clouds: PointClouds) -> None:
    """Raise InputError unless the clouds are a batch whose fields fit each other; points and colours are floating."""
    if not isinstance(clouds, PointClouds) or clouds.points.ndim != 3:
        actual = f"points {list(clouds.points.shape)}" if isinstance(clouds, PointClouds) else type(clouds).__name__
        raise InputError(f"clouds is {actual}; expected PointClouds with points [B, N, 3]; use PointClouds.pack")
    b, n, _ = (max(size, 1) for size in clouds.points.shape)
    shapes = {"points": (b, n, 3), "colors": (b, n, 3), "mask": (b, n), "camera": (b, 3), "boundary": (b, n)}
    for name, shape in shapes.items():
        array, kind = getattr(clouds, name), "floating " if len(shape) == 3 else ""
        dtype = getattr(array, "dtype", type(array))
        # JAX would read the bytes of an array of the other byte order in the wrong order.
        if np.shape(array) != shape or (kind and not (jnp.issubdtype(dtype, jnp.floating) and dtype.isnative)):
            raise InputError(
                f"clouds.{name} is {getattr(dtype, '__name__', dtype)} {list(np.shape(array))}; expected {kind}"
                f"{list(shape)}, with at least one cloud and one point; use PointClouds.pack"
            )


def check_types(**arguments: object) -> None:
    """Raise InputError unless each argument has the type that belongs to its name."""
    for name, value in arguments.items():
        expected = _TYPES[name]
        if not isinstance(value, expected):
            raise InputError(f"{name} is of type {type(value).__name__}; expected a {expected[0].__name__}")


def check_cloud(pair: tuple[ArrayLike, ArrayLike], name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return a cloud's xyz [n, 3], metres, and rgb [n, 3] in [0, 1]; `name` stands for the cloud in messages.

    Raises:
        InputError: the cloud is not a pair, or has a wrong shape or type, coordinates that are not finite in float32,
            or colours out of range.
    """
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InputError(f"{name} is of type {type(pair).__name__}; expected a pair (xyz, rgb)")
    points, colors = as_array(pair[0], f"{name}: xyz"), as_array(pair[1], f"{name}: rgb")
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        raise InputError(f"{name}: xyz is {points.dtype} {list(points.shape)}; expected floating [n, 3], in metres")
    if colors.shape != points.shape:
        raise InputError(f"{name}: rgb is {list(colors.shape)}; expected {list(points.shape)}, the shape of xyz")
    finite = np.isfinite(_as_float32(points))
    if not finite.all():
        bad = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise InputError(f"{name}: xyz[{bad}] is {points[bad].tolist()}; expected numbers that are finite in float32")
    if colors.dtype == np.uint8:
        return _as_float32(points), colors.astype(np.float32) / np.float32(255)
    if not np.issubdtype(colors.dtype, np.floating):
        raise InputError(f"{name}: rgb is {colors.dtype}; expected uint8, or floating in [0, 1]")
    inside = (colors >= 0) & (colors <= 1)
    if not inside.all():
        bad = int(np.flatnonzero(~inside.all(axis=1))[0])
        raise InputError(f"{name}: rgb[{bad}] is {colors[bad].tolist()}; expected floating colours in [0, 1]")
    return _as_float32(points), _as_float32(colors)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Strips:
    """The extremes and the colour vector of every strip of aligned clouds, from which descriptors are computed.

    Attributes:
        low: [..., S, J] float32, smallest y of the points of the strip, scaled units; 0 if it is empty.
        high: [..., S, J] float32, largest y of the points of the strip, scaled units; 0 if it is empty.
        occupied: [..., S, J] bool, True if the strip has a point.
        color: [..., S, J, R] float32, colour vectors Phi^j of the strips, the rows of the colour matrix C^i.
        overflow: [...] int32, number of points outside the grid of slices and strips.
    """

    low: jax.Array
    high: jax.Array
    occupied: jax.Array
    color: jax.Array
    overflow: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Diagrams:
    """Finite H0 persistence pairs of every slice, padded to the number of strips.

    Attributes:
        births: [..., S, J] float32, scaled units; 0 on padding.
        deaths: [..., S, J] float32, scaled units; 0 on padding.
        mask: [..., S, J] bool, False on padding.
    """

    births: jax.Array
    deaths: jax.Array
    mask: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Descriptors:
    """TOPS, TOPS2 and the colour embeddings (CE) of a batch of clouds.

    Attributes:
        images: [B, S, P, P] float32, persistence images, axes birth and persistence; zeros for an absent slice.
        embeddings: [B, S, R, J] float32, colour embeddings E^i = (C^i Delta)^T, axes region and strip.
        overflow: [B] int32, number of points outside the grid of slices and strips, plus number of strips whose
            persistence exceeds the image window. The descriptor leaves these out; 0 means that it covers the cloud.
    """

    images: jax.Array
    embeddings: jax.Array
    overflow: jax.Array

    @property
    def tops(self) -> jax.Array:
        """The shape descriptor TOPS, [B, S * P * P] (7,168 floats): the images of the slices one after the other."""
        return self.images.reshape(*self.overflow.shape, -1)

    @property
    def color(self) -> jax.Array:
        """The colour descriptor CE, [B, S * R * J] (4,774 floats): the embeddings one after the other."""
        return self.embeddings.reshape(*self.overflow.shape, -1)

    @property
    @jax.jit
    def tops2(self) -> jax.Array:
        """The shape and colour descriptor TOPS2, [B, S * (P * P + R * J)] (11,942 floats).

        It has one block [image | embedding] for each slice.
        """
        blocks = [a.reshape(*a.shape[:-2], -1) for a in (self.images, self.embeddings)]
        return jnp.concatenate(blocks, axis=-1).reshape(*self.images.shape[:-3], -1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class Parameters:
    """Learnable parameters of a descriptor, which replace the same values of the network and the config.

    Attributes:
        similarity: [R, R] float32, the similarity matrix Delta.
        alpha: [] float32, angle of the rotation about y, radians. The gradient of the hard descriptor is zero, since
            alpha only changes which slice and strip a point is in; the gradient of a relaxed descriptor is not zero.
        sigma_s: [] float32, scaled units per metre.
        image_variance: [] float32, positive; variance of the Gaussian at each point of a diagram.
        persistence_weight: [] float32, exponent n of the weight persistence**n.
    """

    similarity: jax.Array
    alpha: jax.Array
    sigma_s: jax.Array
    image_variance: jax.Array
    persistence_weight: jax.Array

    @classmethod
    def of(cls, network: ColorNetwork, config: DescriptorConfig) -> "Parameters":
        """Return the parameters that a network and a config contain.

        Raises:
            InputError: `network` or `config` is of another type.
        """
        check_types(network=network, config=config)
        # The arrays are concrete even while a caller's function is traced, so that they can be cached.
        with jax.ensure_compile_time_eval():
            values = config.alpha, config.sigma_s, config.image_variance, config.persistence_weight
            # NumPy converts the values, since JAX would compile a program for each conversion.
            return cls(*(jax.device_put(np.asarray(value, np.float32)) for value in (network.similarity, *values)))


_TYPES = {
    "network": (ColorNetwork,),
    "config": (DescriptorConfig,),
    "parameters": (Parameters, type(None)),
    "strips": (Strips,),
    "diagrams": (Diagrams,),
}
"""Types of the arguments that `check_types` checks."""
