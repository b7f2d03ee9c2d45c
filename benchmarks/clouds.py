"""Inputs of benchmarks: clouds, frames, and a run with random weights.

The clouds are views of real scans if available, otherwise of the built-in objects.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from flax import nnx
from numpy.typing import NDArray

import colornet
from thor2_jax.config import DescriptorConfig
from thor2_jax.frames.frames import RGBDFrame, backproject
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.networks.networks import FEATURES, MLP, input_size
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh
from training.objects.meshes import find_meshes, load_mesh
from training.rendering.camera import RayCaster, camera_pose
from training.rendering.scenes import compose_scene

__all__ = ["SCANS", "make_frames", "random_run", "sample_clouds"]

SCANS = Path(__file__).resolve().parents[2] / "shared" / "data" / "meshes"
N_OBJECTS, N_VIEWS = 24, 8

Cloud = tuple[NDArray[np.float32], NDArray[np.uint8]]


def _objects() -> tuple[str, list[TexturedMesh]]:
    if SCANS.is_dir():
        paths = list(find_meshes(SCANS).values())
        step = max(1, len(paths) // N_OBJECTS)
        return "views of real scans", [load_mesh(path) for path in paths[::step][:N_OBJECTS]]
    return "views of built-in objects", list(builtin_objects().values())


def sample_clouds(count: int, n_points: int, seed: int = 0) -> tuple[str, list[Cloud]]:
    """Return a description of the clouds, and `count` clouds of exactly `n_points` points.

    Points are drawn at random from the pixels of a view, without repetition if there are enough pixels. If there are
    fewer views than clouds, views are reused with other random points.
    """
    rng = np.random.default_rng(seed)
    name, meshes = _objects()
    views = []
    for mesh in meshes:
        caster = RayCaster([mesh])
        for _ in range(N_VIEWS):
            pose = camera_pose(rng.uniform(0, 2 * np.pi), rng.uniform(0.3, 2.8), mesh.centre)
            view = caster.render(pose)
            seen = view.depth > 0
            points = backproject(view.depth.astype(np.float32) / np.float32(1000), view.intrinsics)[seen]
            views.append((points, view.color[seen]))
    clouds = []
    for k in range(count):
        points, colors = views[k % len(views)]
        pick = rng.choice(len(points), n_points, replace=len(points) < n_points)
        clouds.append((points[pick], colors[pick]))
    return name, clouds


def make_frames(n_objects: int) -> Iterator[RGBDFrame]:
    """Yield rendered frames of 640 x 480 pixels with this number of visible objects, without end."""
    objects = builtin_objects()
    for seed in itertools.count():
        frame = compose_scene(objects, np.random.default_rng(seed), n_objects=n_objects).frame
        if len(frame.instances) == n_objects:
            yield frame


def random_run() -> TrainedRun:
    """Return a run with classifiers of 17 classes that have random weights."""
    config, network = DescriptorConfig(homology="closed_form"), colornet.load_default()
    classifiers = {name: MLP(input_size(name, config, network.n_regions), 17, rngs=nnx.Rngs(0)) for name in FEATURES}
    return TrainedRun(config, network, tuple(map(str, range(17))), classifiers, {})
