"""Compute the golden files of the built-in objects with an independent float64 reference.

    python tests/golden/make_golden.py        # rewrites tests/golden/objects/*.npz; a test compares

The reference is NumPy and SciPy. Of the packages, it uses the meshes of the built-in objects, the packaged colour
network and `reference_descriptor`, and nothing that runs in JAX. The diagrams and images in the files are those of
gudhi and persim, which `reference_descriptor` reproduces. Each file is one view of one object:

| array | shape | meaning |
|---|---|---|
| points, colors | [n, 3] | input cloud, scaled units (metres x 2.5), camera frame, camera at the origin; sRGB |
| box_extent | [3] | side lengths of the reference's bounding box, longest first, scaled units |
| aligned | [n, 3] | view-normalized cloud, turned by alpha, in the first octant; same order as points |
| released_diagrams | [k, 3] | slice, birth, death |
| released_images | [7, 32, 32] | persistence images; axis 1 is birth, axis 2 is persistence |
| released_color | [7, 31, 22] | colour vectors of the strips, divided by their number of points |
| paper_images | [7, 32, 32] | the same by the paper's equations |
| paper_color, paper_embedding | [7, 31, 22] | sums of region weights, and these times Delta |
| view | [2] | azimuth and polar angle of the camera, radians |
"""

import dataclasses
import math
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

import colornet
from thor2_jax.config import DescriptorConfig
from thor2_jax.testing.values import reference_descriptor
from training.objects.builtin_objects import builtin_objects
from training.objects.mesh import TexturedMesh

FOLDER = Path(__file__).parent / "objects"

VIEWS = {
    "mug_blue": (0.7, 1.1),
    "banana": (2.1, 0.6),
    "hammer": (1.0, 0.8),
    "white_bowl": (3.3, 0.9),
    "yellow_bottle": (4.0, 1.3),
    "soup_can_red": (5.2, 1.2),
    "sponge": (0.3, 0.7),
}
"""Azimuth and polar angle, in radians, at which each object is seen."""

CONFIGS = DescriptorConfig(), DescriptorConfig.released()
SCALE, STRIP, ALPHA = 2.5, 0.025, math.pi / 4
VOXEL = 0.01
DISTANCE = 1.5
WIDTH, HEIGHT, FIELD_OF_VIEW = 800, 600, math.radians(40)

Array = np.ndarray


def render(mesh: TexturedMesh, azimuth: float, polar: float) -> tuple[Array, Array]:
    """Return the depth [H, W] in whole millimetres (0: background) and the colour [H, W, 3] seen from 1.5 m."""
    outward = np.array([math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth), math.cos(polar)])
    sideways = np.array([-math.sin(azimuth), math.cos(azimuth), 0])
    down = np.cross(-outward, sideways)
    used = mesh.vertices[np.unique(mesh.faces)]
    position = (used.min(axis=0) + used.max(axis=0)) / 2 + DISTANCE * outward
    vertices = (mesh.vertices - position) @ np.stack([sideways, down, -outward]).T
    focal, centre = WIDTH / 2 / math.tan(FIELD_OF_VIEW / 2), (np.array([WIDTH, HEIGHT]) - 1) / 2
    depth, color = np.full((HEIGHT, WIDTH), np.inf), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for number, face in enumerate(mesh.faces):
        corners = vertices[face]
        pixels = corners[:, :2] / corners[:, 2:] * focal + centre
        (left, top), (past, below) = np.ceil(pixels.min(axis=0)).astype(int), np.floor(pixels.max(axis=0)).astype(int)
        columns, rows = (grid.ravel() for grid in np.meshgrid(np.arange(left, past + 1), np.arange(top, below + 1)))
        if len(rows) == 0 or abs(np.linalg.det(corners)) < 1e-15:
            continue
        rays = np.stack([(columns - centre[0]) / focal, (rows - centre[1]) / focal, np.ones(len(rows))])
        # depth * ray = corners' combination by barycentric weights, so the solution is the weights over the depth.
        weights = np.linalg.solve(corners.T, rays)
        z = 1 / np.where((weights >= -1e-12).all(axis=0), weights.sum(axis=0), 1e-9)
        nearer = z < np.minimum(depth[rows, columns], 10)
        rows, columns, z, weights = rows[nearer], columns[nearer], z[nearer], weights[:, nearer]
        depth[rows, columns] = z
        uv = (weights * z).T @ mesh.uv[number]
        texture = mesh.textures[mesh.face_texture[number]]
        sizes = np.array([texture.shape[1], texture.shape[0]])
        u, v = (np.floor(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1) * sizes).astype(int) % sizes).T
        color[rows, columns] = texture[v, u]
    return np.where(np.isfinite(depth), np.rint(depth * 1000), 0), color


def cloud(depth: Array, color: Array) -> tuple[Array, Array]:
    """Return the points in scaled units and the 8-bit colours of the voxels of 0.01 that the view fills."""
    rows, columns = np.nonzero(depth)
    # Metres in float32, as in the released pipeline: every fourth millimetre lies on a border between voxels.
    z = (depth[rows, columns].astype(np.float32) / np.float32(1000)).astype(np.float64)
    focal = WIDTH / 2 / math.tan(FIELD_OF_VIEW / 2)
    points = np.stack([(columns - (WIDTH - 1) / 2) * z / focal, (rows - (HEIGHT - 1) / 2) * z / focal, z], 1) * SCALE
    voxel = np.floor((points - (points.min(axis=0) - VOXEL / 2)) / VOXEL)
    _, member, count = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    means = np.zeros((len(count), 6))
    np.add.at(means, member.ravel(), np.concatenate([points, color[rows, columns]], axis=1))
    means /= count[:, None]
    return means[:, :3], np.rint(means[:, 3:]).astype(np.uint8)


def refined(axes: Array, points: Array, first: int, second: int) -> Array:
    """Rotate two axes so that the minimum-area rectangle of the projection onto them is axis-aligned."""
    plane = points @ axes[[first, second]].T
    hull = plane[ConvexHull(plane).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    turns = [np.array([[x, y], [-y, x]]) / np.hypot(x, y) for x, y in edges]
    new = axes.copy()
    new[[first, second]] = min(turns, key=lambda turn: np.prod(np.ptp(hull @ turn.T, axis=0))) @ new[[first, second]]
    return new


def longest_first(axes: Array, points: Array) -> Array:
    axes = axes[np.argsort(-np.ptp(points @ axes.T, axis=0))]
    return np.stack([axes[0], axes[1], np.cross(axes[0], axes[1])])


def normalized(points: Array) -> Array:
    """Return the view-normalized cloud in the first octant; the camera is at the origin."""
    hull = points[ConvexHull(points).vertices]
    axes = longest_first(np.linalg.eigh(np.cov(hull.T))[1].T, points)
    axes = longest_first(refined(refined(axes, points, 0, 1), points, 1, 2), points)
    rotated = points @ axes.T
    middle = (rotated.min(axis=0) + rotated.max(axis=0)) / 2
    if middle[2] < 0:  # the camera is on the +z side of the box
        rotated[:, 1:] *= -1
    if rotated[:, 0].mean() > (rotated[:, 0].min() + rotated[:, 0].max()) / 2:  # the heavier half comes first
        rotated[:, :2] *= -1
    return rotated - rotated.min(axis=0)


def turned(points: Array) -> Array:
    """Return the cloud rotated by -alpha about y, in the first octant."""
    c, s = math.cos(ALPHA), math.sin(ALPHA)
    rotated = points @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]).T
    return rotated - rotated.min(axis=0)


def golden(mesh: TexturedMesh, azimuth: float, polar: float) -> dict[str, Array]:
    """Return the arrays of one file."""
    points, colors = cloud(*render(mesh, azimuth, polar))
    points = points.astype(np.float32)
    normal = normalized(points.astype(np.float64))
    aligned = turned(normal).astype(np.float32)
    network = colornet.load_default()
    counting = dataclasses.replace(network, similarity=np.eye(network.n_regions))
    paper, released = (reference_descriptor(aligned, colors, counting, config) for config in CONFIGS)
    slices, strips = np.nonzero(released.counts)
    births = STRIP * strips
    color = paper.embeddings.transpose(0, 2, 1)
    return {
        "points": points,
        "colors": (colors / 255).astype(np.float32),
        "box_extent": normal.max(axis=0),
        "aligned": aligned,
        "released_diagrams": np.column_stack([slices, births, births + released.persistence[slices, strips]]),
        "released_images": released.images.astype(np.float32),
        "released_color": released.embeddings.transpose(0, 2, 1).astype(np.float32),
        "paper_images": paper.images.astype(np.float32),
        "paper_color": color.astype(np.float32),
        "paper_embedding": (color @ network.similarity).astype(np.float32),
        "view": np.array([azimuth, polar]),
    }


if __name__ == "__main__":
    objects = builtin_objects()
    for name, angles in VIEWS.items():
        np.savez_compressed(FOLDER / f"{name}.npz", **golden(objects[name], *angles))
