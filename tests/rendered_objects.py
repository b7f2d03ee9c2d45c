"""Files of meshes, scenes of built-in objects, and the images of rendered views."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from image_files import write_frame_files
from numpy.typing import ArrayLike, NDArray
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import Camera, RenderedView
from training.rendering.scenes import compose_scene

QUAD = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
QUAD_FACES = np.array([[0, 1, 2], [0, 2, 3]])
QUAD_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)


def textured_quad(material: PBRMaterial | SimpleMaterial, uv: np.ndarray = QUAD_UV) -> trimesh.Trimesh:
    """Return a square of 0.1 m with texture coordinates."""
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(QUAD, QUAD_FACES, visual=visual, process=False)


def colored(vertices: np.ndarray, colors: ArrayLike = ((99, 99, 99),) * 4) -> trimesh.Trimesh:
    """Return the square, or one with other vertices, with a colour for each vertex."""
    return trimesh.Trimesh(vertices, QUAD_FACES, vertex_colors=colors, process=False)


def write_box(path: Path, sides: Sequence[float], color: Sequence[int] = (200, 100, 50)) -> Path:
    """Write a mesh of a box of one colour."""
    box = trimesh.creation.box(sides)
    box.visual.vertex_colors = [[*color, 255]] * len(box.vertices)
    path.parent.mkdir(parents=True, exist_ok=True)
    box.export(path)
    return path


def write_meshes(directory: Path, names: Sequence[str]) -> Path:
    """Write built-in objects to PLY files with vertex colours."""
    directory.mkdir(exist_ok=True)
    objects = builtin_objects()
    for name in names:
        mesh = objects[name]
        colors = mesh.colors_at(np.arange(len(mesh.faces)), np.full((len(mesh.faces), 2), 1 / 3, np.float32))
        corners = mesh.vertices[mesh.faces].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        plain = trimesh.Trimesh(corners, faces, vertex_colors=np.repeat(colors, 3, axis=0), process=False)
        plain.export(directory / f"{name}.ply")
    return directory


def write_scene(folder: Path, names: Sequence[str], seed: int) -> Path:
    """Write a labelled frame of built-in objects on a table."""
    objects = builtin_objects()
    scene = compose_scene({name: objects[name] for name in names}, np.random.default_rng(seed), n_objects=len(names))
    return write_frame_files(folder, scene.frame, scene.truth)


def full_image(view: RenderedView, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
    """Return the uncropped image of a view: color [H, W, 3] uint8 and depth [H, W] uint16; `camera` rendered it."""
    rows, columns = (slice(c, c + n) for c, n in zip(view.corner, view.depth.shape, strict=True))
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = np.zeros((camera.height, camera.width), np.uint16)
    color[rows, columns], depth[rows, columns] = view.color, view.depth
    return color, depth
