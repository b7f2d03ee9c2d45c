"""The records that flow between the stages. Each is frozen, a pytree of arrays, and names its fields' shapes.

B is the number of clouds, N the padded number of points, S slices, J strips, R colour regions, P pixels of an image's
side.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from thor2_jax.capacity import POINT_BUCKETS, point_bucket
from thor2_jax.errors import InputError

__all__ = ["Cloud", "Descriptors", "Diagrams", "PointClouds", "Strips"]

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]
"""One point cloud of any size: xyz [n, 3] and sRGB [n, 3]."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointClouds:
    """A batch of coloured clouds, padded to one size.

    Attributes:
        points: [B, N, 3] float32. Metres in the camera frame for input; scaled units after view normalization.
        colors: [B, N, 3] float32, sRGB in [0, 1].
        mask: [B, N] bool, False on padding.
        camera: [B, 3] float32, the camera's position in the frame of `points`.
        boundary: [B, N] bool, points on the object's occlusion boundary; all False for unoccluded or training views.
    """

    points: jax.Array
    colors: jax.Array
    mask: jax.Array
    camera: jax.Array
    boundary: jax.Array

    @classmethod
    def pack(
        cls,
        clouds: Sequence[tuple[ArrayLike, ArrayLike]],
        capacity: int | None = None,
        camera: ArrayLike | None = None,
        boundary: Sequence[ArrayLike | None] | None = None,
        *,
        on_host: bool = False,
    ) -> "PointClouds":
        """Pad a list of clouds to one size.

        Args:
            clouds: pairs (xyz [n, 3] metres, rgb [n, 3] sRGB: uint8, or floating in [0, 1]). A cloud may be empty
                (n = 0): it is all padding, and its descriptor is zero.
            capacity: padded number of points; by default the bucket of the largest cloud.
            camera: [3] or [B, 3], the camera's position; by default the origin.
            boundary: one [n] bool array (or None) a cloud: the points on the occlusion boundary.
            on_host: the fields are NumPy arrays; a compiled function takes them to the device sooner than this does.

        Raises:
            InputError: no clouds, wrong shapes or types, coordinates that are not finite in float32, colours out of
                range, a cloud larger than `capacity` or the largest bucket, a capacity that is no positive integer,
                a camera that is not finite or of another shape. The message gives the cloud's index.
        """
        if len(clouds) == 0:
            raise InputError("clouds is empty; at least one (xyz, rgb) pair is needed")
        parts = [_checked(pair, f"clouds[{i}]") for i, pair in enumerate(clouds)]
        sizes = [len(xyz) for xyz, _ in parts]
        n = _padded_size(sizes, capacity)
        points = np.zeros((len(parts), n, 3), np.float32)
        colors = np.zeros((len(parts), n, 3), np.float32)
        edge = np.zeros((len(parts), n), bool)
        if boundary is not None and len(boundary) != len(parts):
            raise InputError(f"boundary has {len(boundary)} entries for {len(parts)} clouds")
        for i, (xyz, rgb) in enumerate(parts):
            points[i, : sizes[i]], colors[i, : sizes[i]] = xyz, rgb
            if boundary is not None and boundary[i] is not None:
                flags = np.asarray(boundary[i])
                if flags.shape != (sizes[i],) or flags.dtype != bool:
                    raise InputError(f"boundary[{i}] is {flags.dtype} {list(flags.shape)}; expected bool [{sizes[i]}]")
                edge[i, : sizes[i]] = flags
        position = np.zeros(3, np.float32) if camera is None else _position(camera, len(parts))
        mask = np.arange(n) < np.array(sizes)[:, None]
        position = np.broadcast_to(position, (len(parts), 3))
        fields: Any = points, colors, mask, position, edge
        return cls(*(fields if on_host else jax.device_put(fields)))


def _padded_size(sizes: list[int], capacity: int | None) -> int:
    largest = max(sizes)
    if capacity is None:
        if largest > POINT_BUCKETS[-1]:
            raise InputError(
                f"clouds[{sizes.index(largest)}] has {largest} points, more than the largest bucket, "
                f"{POINT_BUCKETS[-1]}; voxel it more coarsely or give a capacity"
            )
        return point_bucket(largest)
    if not isinstance(capacity, int) or isinstance(capacity, bool) or capacity < 1:
        raise InputError(f"capacity is {capacity!r}; it must be a positive integer")
    if largest > capacity:
        raise InputError(f"capacity is {capacity}, but clouds[{sizes.index(largest)}] has {largest} points")
    return capacity


def _position(camera: ArrayLike, n_clouds: int) -> NDArray[np.float32]:
    try:
        position = _single(np.asarray(camera, np.float64))
    except (TypeError, ValueError):
        raise InputError(f"camera is {camera!r}; expected numbers, [3] or [{n_clouds}, 3]") from None
    if position.shape not in ((3,), (n_clouds, 3)) or not np.isfinite(position).all():
        raise InputError(f"camera is {position.tolist()}; expected finite [3] or [{n_clouds}, 3]")
    return position


def _single(values: NDArray[Any]) -> NDArray[np.float32]:
    """To float32, without a warning where a value is too large: that becomes infinity, which the caller refuses."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _checked(pair: tuple[ArrayLike, ArrayLike], name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InputError(f"{name} is a {type(pair).__name__}; expected a pair (xyz, rgb)")
    points, colors = np.asarray(pair[0]), np.asarray(pair[1])
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        raise InputError(f"{name}: xyz is {points.dtype} {list(points.shape)}; expected floating [n, 3], metres")
    if colors.shape != points.shape:
        raise InputError(f"{name}: rgb is {list(colors.shape)}; expected {list(points.shape)}, as xyz")
    finite = np.isfinite(_single(points))
    if not finite.all():
        bad = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise InputError(f"{name}: xyz[{bad}] is {points[bad].tolist()}; every coordinate must be finite in float32")
    if colors.dtype == np.uint8:
        return _single(points), colors.astype(np.float32) / np.float32(255)
    if not np.issubdtype(colors.dtype, np.floating):
        raise InputError(f"{name}: rgb is {colors.dtype}; expected uint8, or floating in [0, 1]")
    inside = (colors >= 0) & (colors <= 1)
    if not inside.all():
        bad = int(np.flatnonzero(~inside.all(axis=1))[0])
        raise InputError(f"{name}: rgb[{bad}] is {colors[bad].tolist()}; floating colours must lie in [0, 1]")
    return _single(points), _single(colors)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Strips:
    """What a descriptor needs of an aligned cloud, strip by strip (fields [..., S, J] and [..., S, J, R]).

    Attributes:
        low: [..., S, J] float32, least y of the strip's points; 0 where the strip is empty.
        high: [..., S, J] float32, greatest y of the strip's points; 0 where the strip is empty.
        occupied: [..., S, J] bool, the strip has a point.
        color: [..., S, J, R] float32, strip colour vectors Phi^j (rows of the colour matrix C^i).
        overflow: [...] int32, points outside the slices and strips.
    """

    low: jax.Array
    high: jax.Array
    occupied: jax.Array
    color: jax.Array
    overflow: jax.Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Diagrams:
    """Finite H0 persistence pairs, a slice a row, padded to the number of strips.

    Attributes:
        births: [..., S, J] float32, scaled units; 0 on padding.
        deaths: [..., S, J] float32, scaled units; 0 on padding.
        mask: [..., S, J] bool, True where there is a pair.
    """

    births: jax.Array
    deaths: jax.Array
    mask: jax.Array


@jax.jit
def _side_by_side(images: jax.Array, embeddings: jax.Array) -> jax.Array:
    """[..., S, P, P] and [..., S, R, J] to [..., S * (P * P + R * J)], slice by slice."""
    blocks = [a.reshape(*a.shape[:-2], -1) for a in (images, embeddings)]
    return jnp.concatenate(blocks, axis=-1).reshape(*images.shape[:-3], -1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Descriptors:
    """TOPS, TOPS2 and the colour embeddings (CE) of a batch of clouds.

    Attributes:
        images: [B, S, P, P] float32, persistence images; axes birth, persistence; zeros for an absent slice.
        embeddings: [B, S, R, J] float32, colour embeddings E^i = (C^i Delta)^T.
        overflow: [B] int32, points outside the slices and strips plus strips whose persistence is past the window.
            Nothing is dropped in silence: where this is not zero, the descriptor misses that much of the cloud.
    """

    images: jax.Array
    embeddings: jax.Array
    overflow: jax.Array

    @property
    def tops(self) -> jax.Array:
        """Shape descriptor TOPS [B, S * P * P] (7,168 floats)."""
        return self.images.reshape(*self.overflow.shape, -1)

    @property
    def color(self) -> jax.Array:
        """Colour embeddings alone, CE [B, S * R * J] (4,774 floats)."""
        return self.embeddings.reshape(*self.overflow.shape, -1)

    @property
    def tops2(self) -> jax.Array:
        """Shape and colour descriptor TOPS2 [B, S * (P * P + R * J)] (11,942 floats).

        One block [image | embedding] a slice.
        """
        return _side_by_side(self.images, self.embeddings)
