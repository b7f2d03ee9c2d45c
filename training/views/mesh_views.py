"""Training clouds: one coloured point cloud a view of a mesh (paper, section "Training").

    views = render_views(find_meshes("meshes"), azimuth_step=5, polar_step=5, workers=2)     # name -> clouds

For more views than memory holds: `render_dataset`.
"""

import dataclasses
import hashlib
import itertools
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.recognition.frames import backproject
from thor2_jax.recognition.prepared_instance import DESCRIPTOR_VOXEL
from thor2_jax.recognition.voxel_grid import downsample_to_fit
from thor2_jax.types import Cloud
from training.augmentation.augmentations import Augmentations, augment
from training.objects.mesh import TexturedMesh
from training.objects.meshes import load_mesh
from training.rendering.camera import TRAINING_CAMERA, Camera, RenderedView
from training.rendering.ray_caster import RayCaster, render_view
from training.rendering.view_sphere import camera_pose, view_angles
from training.storage.workers import local_workers

__all__ = [
    "MIN_POINTS",
    "Progress",
    "ViewCloud",
    "ViewTask",
    "checked_meshes",
    "clouds_per_view",
    "cloud_of",
    "render_task",
    "render_views",
    "view_cloud",
    "view_tasks",
]

SIGMA_S = DescriptorConfig().sigma_s

MIN_POINTS = 30
"""Views with fewer points are left out: too little of the object is seen to describe it."""

VIEWS_PER_TASK = 256
"""Views a task: long against sending a mesh and indexing it (0.03 s), short against its 2,664 views."""

Progress = Callable[[int, int], object]
"""Called with (views done, views in all)."""


def cloud_of(view: RenderedView) -> Cloud:
    """Back-project a rendered view and voxel it at 0.01 scaled units; coarser, as in recognition, to fit a bucket.

    Returns:
        xyz [n, 3] float32, metres, camera frame; rgb [n, 3] uint8. n may be 0.
    """
    # Metres in float32, all else in float64: every fourth millimetre lies on a border between voxels, and this is how
    # the clouds of the released pipeline fall on either side.
    depth = view.depth.astype(np.float32) / np.float32(1000)
    seen = view.depth > 0
    points = backproject(depth, view.intrinsics)[seen].astype(np.float64) * SIGMA_S
    points, colors = downsample_to_fit(points, view.color[seen].astype(np.float64), DESCRIPTOR_VOXEL)
    return (points / SIGMA_S).astype(np.float32), np.rint(colors).astype(np.uint8)


def view_cloud(mesh: TexturedMesh, pose: NDArray[np.float64], camera: Camera = TRAINING_CAMERA) -> Cloud:
    """The training cloud of one view: rendered, depth in steps of 1 mm, back-projected, voxelled at 0.01 scaled units.

    Indexes the mesh anew at every call; for many views use `render_views`.

    Args:
        mesh: metres, z up.
        pose: [4, 4] camera to object frame, as from `camera_pose`.
        camera: 800 x 600 pixels, 40 degrees by default.

    Returns:
        xyz [n, 3] float32, metres, camera frame; rgb [n, 3] uint8.

    Raises:
        InputError: nothing of the mesh is seen.
    """
    xyz, rgb = cloud_of(render_view(RayCaster([mesh]), pose, camera))
    if len(xyz) == 0:
        raise InputError("the camera at this pose sees nothing of the mesh")
    return xyz, rgb


@dataclasses.dataclass(frozen=True)
class ViewTask:
    """Views of one object to be rendered by one process.

    Attributes:
        name: of the object.
        mesh: metres, z up.
        angles: [n, 2] azimuth and polar angle in radians.
        first: index of the first among all angles of its object.
        augmentations: makes varied copies of each view; None makes none.
        seed: of the augmentations.
    """

    name: str
    mesh: TexturedMesh
    angles: NDArray[np.float64]
    first: int = 0
    augmentations: Augmentations | None = None
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class ViewCloud:
    """The cloud of one view.

    Attributes:
        view: index of the angles among all of its object.
        copy: 0 is as rendered, others are varied.
        xyz: [n, 3] float32, metres, camera frame.
        rgb: [n, 3] uint8.
    """

    view: int
    copy: int
    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]


def clouds_per_view(augmentations: Augmentations | None) -> int:
    """The view as rendered, and its varied copies."""
    return 1 + augmentations.copies if augmentations else 1


def _seed_of(name: str) -> int:
    """A number that stays with the name, whatever other objects there are."""
    return int.from_bytes(hashlib.sha256(name.encode(errors="surrogatepass")).digest()[:8], "little")


def _all_clouds(task: ViewTask) -> Iterator[ViewCloud]:
    caster, centre, name = RayCaster([task.mesh]), task.mesh.centre, _seed_of(task.name)
    for number, (azimuth, polar) in enumerate(task.angles.tolist(), task.first):
        view = render_view(caster, camera_pose(azimuth, polar, centre))
        yield ViewCloud(number, 0, *cloud_of(view))
        for copy in range(1, clouds_per_view(task.augmentations)):
            assert task.augmentations is not None
            rng = np.random.default_rng([task.seed, name, number, copy])
            yield ViewCloud(number, copy, *cloud_of(augment(view, task.augmentations, rng)))


def render_task(task: ViewTask) -> list[ViewCloud]:
    """The clouds of a task with `MIN_POINTS` points or more, view by view, the copies of a view one after the other."""
    return [cloud for cloud in _all_clouds(task) if len(cloud.xyz) >= MIN_POINTS]


def _mesh(source: Path | TexturedMesh) -> TexturedMesh:
    return source if isinstance(source, TexturedMesh) else load_mesh(source)


def checked_meshes(
    found: Mapping[str, Path | TexturedMesh], angles: NDArray[np.float64]
) -> Iterator[tuple[str, TexturedMesh]]:
    """Each object's name and mesh, one in memory at a time, to be told of a useless one before an hour of rendering.

    Raises:
        InputError: no meshes, or one that cannot be read or has no view of `MIN_POINTS` points or more.
    """
    if not found:
        raise InputError("found is empty; at least one mesh is needed")
    for name, source in found.items():
        mesh = _mesh(source)
        if not any(len(cloud.xyz) >= MIN_POINTS for cloud in _all_clouds(ViewTask(name, mesh, angles))):
            raise InputError(f"object {name!r}: none of its {len(angles)} views has {MIN_POINTS} points or more")
        yield name, mesh


def view_tasks(
    found: Mapping[str, Path | TexturedMesh],
    angles: NDArray[np.float64],
    parts: Iterable[tuple[str, int]],
    size: int,
    augmentations: Augmentations | None = None,
    seed: int = 0,
) -> Iterator[ViewTask]:
    """A task for each part, which is an object's name and the index of the first of its `size` angles.

    A mesh is read when the first of the consecutive parts of its object is asked for.
    """
    for name, group in itertools.groupby(parts, key=operator.itemgetter(0)):
        mesh = _mesh(found[name])
        for _, first in group:
            yield ViewTask(name, mesh, angles[first : first + size], first, augmentations, seed)


def render_views(
    found: Mapping[str, Path | TexturedMesh],
    azimuth_step: float = 5.0,
    polar_step: float = 5.0,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> dict[str, list[Cloud]]:
    """Training clouds of every object, in memory (a view of a scan takes about 15 kB).

    Args:
        found: object name -> mesh file, as from `find_meshes`, or mesh.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.
        workers: processes that render; the result does not depend on their number. With more than 1, the calling script
            needs the `if __name__ == "__main__"` guard of `multiprocessing`.
        progress: called from time to time.

    Returns:
        name -> clouds (xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8), in the order of `found` and of
        `view_angles`; views of fewer than `MIN_POINTS` points are left out.

    Raises:
        InputError: no meshes, a mesh that cannot be read or is never seen, or steps or workers that do not fit.
    """
    angles, pool = view_angles(azimuth_step, polar_step), local_workers(workers)
    views: dict[str, list[Cloud]] = {name: [] for name, _ in checked_meshes(found, angles)}
    parts = [(name, first) for name in found for first in range(0, len(angles), VIEWS_PER_TASK)]
    done, total = 0, len(angles) * len(found)
    with closing(pool(render_task, view_tasks(found, angles, parts, VIEWS_PER_TASK))) as results:
        for (name, first), clouds in zip(parts, results, strict=True):
            views[name] += [(cloud.xyz, cloud.rgb) for cloud in clouds]
            done += len(angles[first : first + VIEWS_PER_TASK])
            progress(done, total)
    return views
