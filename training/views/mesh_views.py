"""Render training clouds: one coloured point cloud per view of a mesh (paper, section "Training").

    views = render_views(find_meshes("meshes"), azimuth_step=5, polar_step=5)     # name -> clouds

`render_dataset` writes the views of a `RenderJob` to disk if they do not fit into memory. This module does not import
JAX, so that rendering processes start quickly.
"""

import dataclasses
import functools
import hashlib
import itertools
import operator
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax import DESCRIPTOR_VERSION, DescriptorConfig, InputError
from thor2_jax.frames.outliers import downsample_to_fit
from thor2_jax.frames.prepared_instance import DESCRIPTOR_VOXEL, PreparedInstance
from training.augmentation.augmentations import KINDS, Augmentations, augment
from training.objects.mesh import TexturedMesh
from training.objects.meshes import load_mesh
from training.rendering.camera import TRAINING_CAMERA, RayCaster, RenderedView, camera_pose, random_angles, view_angles

if TYPE_CHECKING:  # not needed by rendering processes; the first one imports JAX
    from thor2_jax.types import Cloud
    from training.storage.jobs import Progress

__all__ = [
    "COORDINATE_STEP",
    "MAX_VIEW_LENGTH",
    "MESH_VIEWS",
    "MIN_VIEW_POINTS",
    "RenderJob",
    "ViewTask",
    "all_views",
    "cloud_of",
    "mesh_views",
    "render_task",
    "render_views",
    "view_cloud",
]

SIGMA_S = DescriptorConfig().sigma_s

MIN_VIEW_POINTS = 30
"""Smallest number of points of a view; with fewer, too little of the object is visible to describe it."""

COORDINATE_STEP = 2.0**-14
"""Resolution of the coordinates, scaled units (0.024 mm)."""

MAX_VIEW_LENGTH = COORDINATE_STEP * np.iinfo(np.uint16).max
"""Largest coordinate, scaled units (1.6 m): multiples of `COORDINATE_STEP` up to it fit into 16 bits."""

CLOUDS_PER_SHARD = 256
"""Clouds per shard of a dataset, rounded down to whole views: a few megabytes, about a second of rendering."""


def cloud_of(view: RenderedView) -> "Cloud":
    """Back-project a rendered view and downsample it to voxels of 0.01 scaled units, or larger voxels to fit a bucket.

    Returns:
        xyz [n, 3] float32, metres, camera frame; rgb [n, 3] uint8. n may be 0.
    """
    # Metres are float32 and the rest is float64, as in the released pipeline. Every fourth millimetre lies on a voxel
    # border, so the result depends on rounding.
    pixels = np.flatnonzero(view.depth)
    points = view.frame.points(pixels).astype(np.float32)
    colors = view.color.reshape(-1, 3).take(pixels, axis=0).astype(np.float64)
    points, colors = downsample_to_fit(points.astype(np.float64) * SIGMA_S, colors, DESCRIPTOR_VOXEL)
    return (points / SIGMA_S).astype(np.float32), np.rint(colors).astype(np.uint8)


def view_cloud(mesh: TexturedMesh, pose: NDArray[np.float64]) -> "Cloud":
    """Return the training cloud of one view: depth in steps of 1 mm, back-projected, voxels of 0.01 scaled units.

    Each call builds the ray-casting index of the mesh; use `render_views` for many views.

    Args:
        mesh: metres, z up.
        pose: [4, 4], camera to object frame, as from `camera_pose`.

    Returns:
        xyz [n, 3] float32, metres, camera frame; rgb [n, 3] uint8.

    Raises:
        InputError: the mesh is not visible.
    """
    xyz, rgb = cloud_of(RayCaster([mesh]).render(pose))
    if len(xyz) == 0:
        raise InputError("pose: the mesh is not visible; expected a camera that looks at it, as from camera_pose")
    return xyz, rgb


@dataclasses.dataclass(frozen=True)
class ViewTask:
    """Views of one object, to be rendered by one process.

    Attributes:
        name: name of the object.
        mesh: metres, z up.
        angles: [n, 2] azimuth and polar angle in radians.
        first: index of the first view among all views of the object.
        augmentations: adds augmented views from random cameras, `copies` for each view; None adds none.
        seed: seed for the augmentations.
    """

    name: str
    mesh: TexturedMesh
    angles: NDArray[np.float64]
    first: int = 0
    augmentations: Augmentations | None = None
    seed: int = 0


def all_views(task: ViewTask) -> Iterator[tuple[int, int, RenderedView]]:
    """Yield the number of the view, the number of the copy and the image of each view, ordered by view and copy."""
    caster, centre = RayCaster([task.mesh]), task.mesh.centre
    name = int.from_bytes(hashlib.sha256(task.name.encode(errors="surrogatepass")).digest()[:8], "little")
    for number, (azimuth, polar) in enumerate(task.angles.tolist(), task.first):
        yield number, 0, caster.render(camera_pose(azimuth, polar, centre))
        if task.augmentations:
            for copy in range(1, 1 + task.augmentations.copies):
                rng = np.random.default_rng([task.seed, name, number, copy])
                other = caster.render(camera_pose(*random_angles(rng), centre))
                yield number, copy, augment(other, task.augmentations, rng)


def render_task(task: ViewTask) -> list[tuple[int, int, "Cloud"]]:
    """Return the clouds of a task that have at least `MIN_VIEW_POINTS` points, ordered by view and copy.

    Each entry has the index of the view among all views of the object, the number of the copy (0 is the view as
    rendered), and the cloud.
    """
    clouds = ((number, copy, cloud_of(view)) for number, copy, view in all_views(task))
    return [(number, copy, cloud) for number, copy, cloud in clouds if len(cloud[0]) >= MIN_VIEW_POINTS]


def _checked_meshes(
    meshes: Mapping[str, Path | TexturedMesh], angles: NDArray[np.float64]
) -> Iterator[tuple[str, TexturedMesh]]:
    """Yield each object's name and mesh, one at a time, so that unusable meshes are found before the long rendering.

    Raises:
        InputError: there are no meshes, or a mesh is unreadable, has views that may be too large to be normalized, or
            has no view of at least `MIN_VIEW_POINTS` points.
    """
    if not meshes:
        raise InputError("meshes is empty; expected at least one mesh")
    for name, source in meshes.items():
        mesh = load_mesh(source)
        diameter = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        if SIGMA_S * diameter > MAX_VIEW_LENGTH:
            raise InputError(
                f"object {name!r} has a diameter of {diameter:.2f} m; at most {MAX_VIEW_LENGTH / SIGMA_S:.2f} m can be "
                "stored; scale the mesh to metres"
            )
        views = all_views(ViewTask(name, mesh, angles))
        if not any(len(cloud_of(view)[0]) >= MIN_VIEW_POINTS for *_, view in views):
            raise InputError(
                f"object {name!r}: none of its {len(angles)} views has at least {MIN_VIEW_POINTS} points; check the "
                "mesh or leave it out"
            )
        yield name, mesh


@dataclasses.dataclass(frozen=True)
class RenderJob:
    """Everything that determines a dataset of views.

    Attributes:
        meshes: object name -> mesh file, as from `find_meshes`, or mesh.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.
        augmentations: adds augmented copies of each view; None adds none.
        seed: seed for the augmentations, at least 0. The copies of an object do not depend on the other objects.
    """

    meshes: Mapping[str, Path | TexturedMesh]
    azimuth_step: float = 5.0
    polar_step: float = 5.0
    augmentations: Augmentations | None = None
    seed: int = 0

    @property
    def angles(self) -> NDArray[np.float64]:
        """Azimuth and polar angle [n, 2] of the views of an object; an invalid step raises InputError."""
        return view_angles(self.azimuth_step, self.polar_step)

    @property
    def copies(self) -> int:
        """Number of clouds of a view: the view as rendered and its augmented copies."""
        return 1 + self.augmentations.copies if self.augmentations else 1

    @functools.cached_property
    def shards(self) -> dict[str, tuple[str, range]]:
        """File name of each shard -> its object and the numbers of its views."""
        size, n_views = max(1, CLOUDS_PER_SHARD // self.copies), len(self.angles)
        return {
            f"{label:04d}-{number:04d}.safetensors": (name, range(first, min(first + size, n_views)))
            for label, name in enumerate(self.meshes)
            for number, first in enumerate(range(0, n_views, size))
        }

    def record(self) -> dict[str, Any]:
        """Check the job and return it in JSON types.

        Raises:
            InputError: there are no meshes, a mesh is unreadable, too large or never visible, or a step or the seed is
                invalid.
        """
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}; it must be at least 0")
        augmentations, checked = self.augmentations, _checked_meshes(self.meshes, self.angles)
        return {
            "descriptor_version": DESCRIPTOR_VERSION,
            "sigma_s": SIGMA_S,
            "voxel": DESCRIPTOR_VOXEL,
            "step": COORDINATE_STEP,
            "min_points": MIN_VIEW_POINTS,
            "camera": TRAINING_CAMERA.record,
            "azimuth_step": float(self.azimuth_step),
            "polar_step": float(self.polar_step),
            "variations": {"seed": self.seed, "cameras": "random", **augmentations.record()} if augmentations else None,
            "objects": [{"name": name, "mesh": mesh.digest} for name, mesh in checked],
            "shards": len(self.shards),
        }

    def read_meshes(self, progress: "Progress") -> Iterator[TexturedMesh]:
        """Read the mesh of each object, one at a time, to compute its surface, while showing the progress."""
        for number, (name, source) in enumerate(self.meshes.items()):
            progress("surfaces", number, len(self.meshes), name)
            yield load_mesh(source)
        progress("surfaces", len(self.meshes), len(self.meshes), "")

    def tasks(self, files: Iterable[str], objects: Iterable[Mapping[str, str]]) -> Iterator[ViewTask]:
        """Yield the task of each of these shards; consecutive shards of an object share one reading of its mesh.

        Raises:
            InputError: a mesh is unreadable, or is not the mesh in `objects`, those of the job's `record`.
        """
        angles, digests = self.angles, {each["name"]: each["mesh"] for each in objects}
        for name, group in itertools.groupby(map(self.shards.__getitem__, files), key=operator.itemgetter(0)):
            mesh = load_mesh(self.meshes[name])
            if mesh.digest != digests[name]:
                raise InputError(f"the mesh of {name!r} has changed during the rendering; restore it, or start anew")
            for _, views in group:
                of_views = angles[views.start : views.stop]
                yield ViewTask(name, mesh, of_views, views.start, self.augmentations, self.seed)


def render_views(
    meshes: Mapping[str, Path | TexturedMesh], azimuth_step: float = 5.0, polar_step: float = 5.0
) -> dict[str, list["Cloud"]]:
    """Render the training clouds of every object to memory (about 15 kB per view of a scan).

    Args:
        meshes: object name -> mesh file, as from `find_meshes`, or mesh.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.

    Returns:
        name -> clouds (xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8), in the order of `meshes` and
        `view_angles`; views with fewer than `MIN_VIEW_POINTS` points are left out.

    Raises:
        InputError: there are no meshes, a mesh is unreadable, too large or never visible, or a step is invalid.
    """
    angles = view_angles(azimuth_step, polar_step)
    tasks = (ViewTask(name, mesh, angles) for name, mesh in _checked_meshes(meshes, angles))
    return {task.name: [cloud for _, _, cloud in render_task(task)] for task in tasks}


MESH_VIEWS = 60
"""Number of cameras around a mesh. Each gives two views: one as rendered, and an augmented one from another camera."""


def _evenly_spread(count: int) -> NDArray[np.float64]:
    """Return azimuth and polar angle [count, 2] of directions that cover the sphere evenly (a Fibonacci spiral)."""
    index = np.arange(count)
    golden_angle = np.pi * (3 - np.sqrt(5))
    return np.stack([index * golden_angle % (2 * np.pi), np.arccos(1 - (2 * index + 1) / count)], axis=1)


def mesh_views(mesh: Path | TexturedMesh, mesh_scale: float = 1.0, cameras: int = MESH_VIEWS) -> list[PreparedInstance]:
    """Render a mesh from all sides, two views per camera; `mesh_scale` converts the unit of a file to metres.

    Raises:
        InputError: the mesh cannot be read, is too large or too small to be in metres, or has no usable view.
        OSError: the file cannot be opened.
    """
    name, loaded = mesh.name if isinstance(mesh, Path) else "mesh", load_mesh(mesh, mesh_scale)
    augmentations = Augmentations.of_names(KINDS, copies=1)
    task = ViewTask(name, loaded, _evenly_spread(cameras), augmentations=augmentations)
    clouds = enumerate(render_task(task))
    views = [PreparedInstance(k, xyz, rgb, np.zeros(len(xyz), bool)) for k, (_, _, (xyz, rgb)) in clouds]
    if not views:
        raise InputError(f"mesh: {name} has too few points in every view; expected an object of a few centimetres")
    return views
