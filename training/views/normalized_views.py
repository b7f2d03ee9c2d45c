"""Normalized views for training, their random orientations and sources (paper, section "View Normalization").

`MemoryViews` keeps them in memory:

    source = MemoryViews(render_views(find_meshes("meshes")), config)

`WithoutClasses` leaves classes out. It is used to evaluate the rejection of unknown objects, and to train one run per
sequence of a dataset on the objects of this sequence only, which is the papers' OCID protocol.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thor2_jax import DescriptorConfig, InputError, view_normalize
from thor2_jax.capacity import batch_points
from thor2_jax.files import content_digest, read_table
from thor2_jax.printable import find_name
from thor2_jax.surfaces.surfaces import Surfaces
from thor2_jax.types import Cloud, PointClouds, matmul
from training.views.crops import ViewCrops
from training.views.mesh_views import COORDINATE_STEP, MAX_VIEW_LENGTH

__all__ = [
    "MemoryViews",
    "NormalizedViews",
    "SourceShard",
    "ViewSource",
    "WithoutClasses",
    "check_classes",
    "fold_of_views",
    "normalize_views",
    "padded_batches",
    "reorient",
    "sequence_sources",
]

CLOUDS_PER_BATCH = 64
"""Batch size of all computations on the clouds of a training."""


def padded_batches(
    clouds: Sequence[Cloud], boundary: Sequence[NDArray[np.bool_]] | None = None
) -> Iterator[tuple[int, PointClouds]]:
    """Yield clouds in batches of `CLOUDS_PER_BATCH`; the last batch is filled up with empty clouds.

    Args:
        clouds: the clouds.
        boundary: for each cloud, which points are on the occlusion boundary, [n] bool; None if no points are.

    Yields:
        The number of clouds in the batch without the empty ones, and the batch, padded by `batch_points`.

    Raises:
        InputError: a cloud has more points than the largest bucket.
    """
    empty: Cloud = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    for start in range(0, len(clouds), CLOUDS_PER_BATCH):
        chunk = list(clouds[start : start + CLOUDS_PER_BATCH])
        padding = CLOUDS_PER_BATCH - len(chunk)
        marks = None if boundary is None else [*boundary[start : start + len(chunk)], *[None] * padding]
        capacity = batch_points(len(xyz) for xyz, _ in chunk)
        yield len(chunk), PointClouds.pack(chunk + [empty] * padding, capacity, boundary=marks)


@dataclasses.dataclass(frozen=True)
class NormalizedViews:
    """Normalized clouds of views of one object.

    Attributes:
        xyz: [n, 3] float32, points of all views, one view after the other; scaled units, first octant, not yet rotated
            by alpha; multiples of `COORDINATE_STEP`.
        rgb: [n, 3] uint8.
        counts: [V] int64, points of each view.
        label: index of the object among the classes.
        view: [V] int32, index of the view among all views of the object.
        copy: [V] int32, 0 is the view as rendered, others are augmented copies.
        camera: [V, 3] float32, position of the camera in the frame of each view, scaled units.
    """

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    counts: NDArray[np.int64]
    label: int
    view: NDArray[np.int32]
    copy: NDArray[np.int32]
    camera: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.counts)

    def clouds(self) -> list[Cloud]:
        """Return the cloud of each view, as slices of this record's arrays."""
        ends = np.cumsum(self.counts)
        return [(self.xyz[end - n : end], self.rgb[end - n : end]) for n, end in zip(self.counts, ends, strict=True)]


class SourceShard(NamedTuple):
    """Class and number of views of a shard that is not on disk."""

    label: int
    views: int


class ViewSource(Protocol):
    """Normalized views in shards of one object each, such as a `ViewDataset` on disk or `MemoryViews`."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Class names."""

    @property
    def digest(self) -> str:
        """Digest of all views; it changes if any view changes."""

    @property
    def record(self) -> Mapping[str, Any]:
        """Description of the views for the record of a run, in JSON types."""

    @property
    def shards(self) -> Sequence[Any]:
        """One entry per shard, with its `label` and its number of `views`."""

    @property
    def surfaces(self) -> Surfaces | None:
        """Surfaces of the classes; None if a class has no mesh."""

    def read(self, index: int) -> NormalizedViews:
        """Read the views of a shard."""

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of the views of a shard, in their order, with sides of `size` pixels.

        Raises:
            InputError: there are no crops, or they are smaller.
        """


def check_classes(source: ViewSource) -> None:
    """Raise InputError if there are fewer than two classes, or a class has no views."""
    if len(source.classes) < 2:
        names = ", ".join(source.classes) or "none"
        raise InputError(f"the objects with views are {names}; expected at least two; add views of another one")
    for label, name in enumerate(source.classes):
        if not any(shard.label == label and shard.views for shard in source.shards):
            raise InputError(f"class {name!r} has no views; render more views or leave it out")


def normalize_views(
    clouds: Sequence[Cloud],
    label: int,
    view: Sequence[int],
    copy: Sequence[int],
    config: DescriptorConfig,
    boundary: Sequence[NDArray[np.bool_]] | None = None,
) -> NormalizedViews:
    """Normalize views of one object; the same clouds in the same order give the same bits.

    Args:
        clouds: one per view: xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8.
        label: index of the object among the classes.
        view: index of each view among all views of the object.
        copy: 0 for a view as rendered, others for augmented copies.
        config: only `sigma_s` is used.
        boundary: points on the occlusion boundary, see `padded_batches`.

    Raises:
        InputError: a cloud has more points than the largest bucket, or is longer than `MAX_VIEW_LENGTH`.
    """
    xyz, camera = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    # This runs on the CPU, since accelerators round differently and rendering should not occupy their memory. Where it
    # is the default device, it is not selected, since programs would then be compiled a second time.
    with jax.default_device(None if jax.default_backend() == "cpu" else jax.local_devices(backend="cpu")[0]):
        for count, batch in padded_batches(clouds, boundary):
            normal = view_normalize(batch, config)
            padded, mask = np.asarray(normal.points)[:count], np.asarray(normal.mask)[:count]
            xyz.append(np.rint(padded[mask] / np.float32(COORDINATE_STEP)) * np.float32(COORDINATE_STEP))
            camera.append(np.asarray(normal.camera)[:count])
    points = np.concatenate(xyz)
    if not (points <= MAX_VIEW_LENGTH).all():
        raise InputError(
            f"a view is {points.max():.3g} scaled units long; at most {MAX_VIEW_LENGTH:.3g} can be stored; check the "
            "unit of the mesh, or the mask and the depth scale of the frame"
        )
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(rgb for _, rgb in clouds)])
    counts = np.array([len(xyz) for xyz, _ in clouds], np.int64)
    numbers = np.array(view, np.int32), np.array(copy, np.int32)
    return NormalizedViews(points, colors, counts, label, *numbers, np.concatenate(camera))


NEARLY_EQUAL = 0.85
"""Smallest ratio of a side of the box to the next longer side at which `reorient` may swap the two."""

MAX_ROTATION = 10.0
"""Largest random rotation of a normalized cloud, degrees."""


@jax.jit
def _reoriented(normal: PointClouds, axes: jax.Array, mirrored: jax.Array) -> PointClouds:
    """Rotate normalized clouds to axes [B, 3, 3], then mirror those in `mirrored` [B] in x; the camera stays at -z."""

    def one(cloud: PointClouds, axes: jax.Array, mirrored: jax.Array) -> PointClouds:
        inside = cloud.mask[:, None]
        middle = cloud.points.max(axis=0) / 2
        points, camera = (matmul(a - middle, axes.T) for a in (cloud.points, cloud.camera))
        low = jnp.where(inside, points, jnp.inf).min(axis=0)
        high = jnp.where(inside, points, -jnp.inf).max(axis=0)
        signs = jnp.stack([mirrored, jnp.zeros_like(mirrored), camera[2] > (low[2] + high[2]) / 2])
        corner = jnp.where(signs, high, low)
        corner = jnp.where(jnp.isfinite(corner), corner, 0)
        sign = jnp.where(signs, -1, 1)
        points = jnp.where(inside, sign * (points - corner), 0)
        return dataclasses.replace(cloud, points=points, camera=sign * (camera - corner))

    return jax.vmap(one)(normal, axes, mirrored)


def _random_axes(sides: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return axes [B, 3, 3] after swaps of nearly equal sides [B, 3] and a small rotation about a random axis."""
    sides, axes = sides.copy(), np.tile(np.eye(3), (len(sides), 1, 1))
    for order, (i, j) in (([1, 0, 2], (0, 1)), ([0, 2, 1], (1, 2))):
        swap = (sides[:, j] > NEARLY_EQUAL * sides[:, i]) & (rng.random(len(sides)) < 0.5)
        sides[swap], axes[swap] = sides[swap][:, order], axes[swap][:, order]
    direction = rng.standard_normal((len(sides), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    angle = np.radians(rng.uniform(0, MAX_ROTATION, (len(sides), 1)))
    return np.asarray(Rotation.from_rotvec(angle * direction).as_matrix() @ axes, np.float32)


def reorient(normal: PointClouds, rng: np.random.Generator) -> PointClouds:
    """Return normalized clouds [B, N] in random orientations, as the normalization might choose in another view.

    Which of two nearly equal sides is longer, and which end has more points, differs between cameras. The axes of the
    box also have errors of some degrees.

    In half of the clouds, two neighbouring sides of the box that are nearly equal are swapped. Each cloud is rotated by
    up to 10 degrees about a random axis. Half of the clouds are mirrored in x, which has the same effect on the
    descriptor as a half turn about z.

    Args:
        normal: clouds as returned by `view_normalize`.
        rng: random number generator for the orientations.
    """
    axes = _random_axes(np.asarray(normal.points.max(axis=1)), rng)
    oriented: PointClouds = _reoriented(normal, axes, rng.random(len(axes)) < 0.5)
    return oriented


class MemoryViews:
    """Source of views from clouds in memory, one shard per class; `read` normalizes them."""

    surfaces: Surfaces | None = None

    def __init__(self, views: Mapping[str, Sequence[Cloud]], config: DescriptorConfig) -> None:
        """Store the clouds; nothing is computed yet.

        Args:
            views: class name -> clouds (xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8).
            config: descriptor; only `sigma_s` is used.
        """
        self.classes = tuple(views)
        self.shards = tuple(SourceShard(label, len(clouds)) for label, clouds in enumerate(views.values()))
        self._clouds = tuple(views.values())
        self._config = config

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the class names and clouds."""
        arrays = (array for clouds in self._clouds for cloud in clouds for array in cloud)
        shards = repr(self.shards).replace("SourceShard", "_Shard")  # the old name, as in the digests of existing runs
        return content_digest(itertools.chain([f"({self.classes!r}, {shards})"], (a.tobytes() for a in arrays)))

    @property
    def record(self) -> Mapping[str, Any]:
        """Digest and number of views, for the record of a run."""
        return {"digest": self.digest, "views": sum(shard.views for shard in self.shards)}

    def read(self, index: int) -> NormalizedViews:
        """Normalize the views of a class.

        Raises:
            InputError: a cloud has more points than the largest bucket, or is too long.
        """
        clouds = self._clouds[index]
        return normalize_views(clouds, index, range(len(clouds)), [0] * len(clouds), self._config)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Raise InputError: clouds in memory have no images."""
        raise InputError("dataset: clouds in memory have no crops; give a rendered dataset with --dataset")


class WithoutClasses:
    """A source of views that omits some classes."""

    def __init__(self, source: ViewSource, names: Sequence[str]) -> None:
        """Omit the classes `names`, which are classes of the source."""
        self.classes = tuple(name for name in source.classes if name not in names)
        new = {source.classes.index(name): label for label, name in enumerate(self.classes)}
        self._kept = [index for index, shard in enumerate(source.shards) if shard.label in new]
        self.shards = tuple(SourceShard(new[each.label], each.views) for each in source.shards if each.label in new)
        self._source, self._names = source, sorted(set(names))
        self._rows = np.array(list(new))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the source's digest and the omitted names."""
        return content_digest([repr((self._source.digest, self._names))])

    @property
    def record(self) -> Mapping[str, Any]:
        """Record of the source and the omitted classes."""
        views = sum(shard.views for shard in self.shards)
        return {**self._source.record, "digest": self.digest, "views": views, "classes_left_out": self._names}

    @property
    def surfaces(self) -> Surfaces | None:
        """Surfaces of the classes; None if the source has none."""
        return jax.tree.map(lambda a: a[self._rows], self._source.surfaces)

    def read(self, index: int) -> NormalizedViews:
        """Read the views of a shard; raise errors as the source does."""
        return dataclasses.replace(self._source.read(self._kept[index]), label=self.shards[index].label)

    def read_crops(self, index: int, size: int) -> ViewCrops:
        """Read the crops of a shard; raise errors as the source does."""
        return self._source.read_crops(self._kept[index], size)


def fold_of_views(
    label: NDArray[np.integer[Any]], view: NDArray[np.integer[Any]], classes: Sequence[str], folds: int, seed: int
) -> NDArray[np.intp]:
    """Return the fold of each cloud [M], from 0; the views of every class are distributed randomly and evenly.

    All clouds of a view (mirrored and augmented copies) are in the same fold, since nearly equal clouds in the training
    set would raise the held-out accuracy.

    Args:
        label: [M], index into `classes`.
        view: [M], index of the view among the views of its object.
        classes: class names.
        folds: number of folds; with 1, all clouds are in fold 0.
        seed: seed for the assignment.

    Raises:
        InputError: a class has fewer views than folds.
    """
    rng = np.random.default_rng(seed)
    fold: NDArray[Any] = np.zeros(len(label), np.intp)
    for index, name in enumerate(classes):
        members = label == index
        views, number = np.unique(view[members], return_inverse=True)
        if len(views) < folds:
            raise InputError(f"folds is {folds}; expected at most {len(views)}, the number of views of class {name!r}")
        fold[members] = (rng.permutation(len(views)) % folds)[number]
    return fold


def sequence_sources(source: ViewSource, table: Path, out: Path) -> dict[Path, ViewSource]:
    """Return the views for the training of each sequence.

    Args:
        source: views of the objects of all sequences.
        table: JSON or YAML file, sequence -> names of its objects, as for the OCID reader.
        out: directory that contains the run directories.

    Returns:
        Run directory of each sequence -> views of its objects.

    Raises:
        InputError: the table is unreadable or empty, a sequence is not a relative path, or the source has no views of
            an object.
    """
    sources: dict[Path, ViewSource] = {}
    for sequence, names in read_table(table).items():
        if not isinstance(sequence, str) or Path(sequence).is_absolute() or {"", ".", ".."} & set(sequence.split("/")):
            raise InputError(f"sequences: {table} has the sequence {sequence!r}; expected a relative path")
        if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
            raise InputError(f"sequences: {table}: {sequence} is {names!r}; expected a list of names")
        if missing := sorted(name for name in set(names) if not find_name(name, source.classes)):
            raise InputError(f"sequences: {table}: the views have no class {', '.join(missing)}, named by {sequence}")
        sources[out / sequence] = WithoutClasses(source, [one for one in source.classes if not find_name(one, names)])
    if not sources:
        raise InputError(f"sequences: {table} has no sequence; expected a table of sequence -> object names")
    return sources
