"""Cluttered table scenes of known objects, rendered with labels, to evaluate recognizers.

    scene = compose_scene(builtin_objects(), np.random.default_rng(0))
    scene.frame, scene.truth[1], scene.visible[1], scene.occlusion(1)

The table is the plane z = 0. Objects rest on it without touching, and occlude each other in a camera that looks down.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from thor2_jax import InputError, Intrinsics, RGBDFrame
from training.objects.mesh import QUAD_FACES, QUAD_UV, TexturedMesh
from training.rendering.camera import Camera, RayCaster, axial_deviation, camera_pose, depth_edges, pixel_rays

__all__ = ["SCENE_CAMERA", "Scene", "compose_scene", "compose_views"]

SCENE_CAMERA = Camera(640, 480, Intrinsics(615.0, 615.0, 319.5, 239.5))
"""Similar to a small active-stereo camera at VGA resolution, with a horizontal field of view of 55 degrees."""

MIN_PIXELS = 50
"""Instances with fewer visible pixels are not labelled."""

MIN_GAP = 0.006
"""Smallest distance between the footprints of two objects, metres."""

TABLE_RADIUS = 0.18
"""Largest distance of objects from the table's centre, metres, if there is enough space."""

MAX_SENSOR_DEPTH = 4.0
"""Largest depth that the simulated sensor measures, metres."""

EDGE_STEP = 0.02
"""Smallest depth step between neighbouring pixels at which depth may be missing, metres."""

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A frame and its ground truth.

    Attributes:
        frame: colour, depth in millimetres, labels from 1 in no particular order; table and background are 0.
        truth: label -> object name.
        visible: label -> visible fraction of the pixels that the object would cover without the others, in (0, 1].
    """

    frame: RGBDFrame
    truth: Mapping[int, str]
    visible: Mapping[int, float]

    def occlusion(self, label: int) -> str:
        """Return the degree of occlusion of an instance: "none" (up to 5 %), "low" (up to 30 %) or "high"."""
        share = self.visible[label]
        return "none" if share > 0.95 else "low" if share > 0.7 else "high"


@dataclasses.dataclass(frozen=True)
class _Placed:
    """A mesh on the table, with the corners [k, 2] and outward normals [k, 2] of its convex footprint."""

    mesh: TexturedMesh
    corners: Array
    normals: Array

    @property
    def height(self) -> float:
        return float(self.mesh.vertices[:, 2].max())

    def apart(self, other: "_Placed", place: Array) -> bool:
        """Return whether this object, moved to `place` [2], is at least `MIN_GAP` from the other (separating axes)."""
        here, there = self.corners + place, other.corners
        gaps = (self.normals @ there.T).min(axis=1) - (self.normals @ here.T).max(axis=1)
        other_gaps = (other.normals @ here.T).min(axis=1) - (other.normals @ there.T).max(axis=1)
        return bool(max(gaps.max(), other_gaps.max()) >= MIN_GAP)


SIDES = Rotation.from_rotvec([[90, 0, 0], [-90, 0, 0], [0, -90, 0], [0, 90, 0]], degrees=True).as_matrix().round()
"""Rotations [4, 3, 3] that turn each of the four sides down."""


def _rests(hull: Array) -> bool:
    """Return whether a body with these hull vertices [n, 3] is stable: its centre is above the contact area.

    Vertices within 3 mm of the table count as touching it, so that a can rests on its side. The centre must be inside
    the contact area by 5 mm and by a tenth of the height, so that a screwdriver does not stand on its handle.
    """
    feet = hull[hull[:, 2] < hull[:, 2].min() + 0.003, :2]
    low, high = hull.min(axis=0), hull.max(axis=0)
    middle = (low + high)[:2] / 2
    if len(feet) < 3 or np.linalg.svd(feet - feet.mean(axis=0), compute_uv=False)[1] < 0.005:
        return False
    sides = ConvexHull(feet).equations
    return bool((sides[:, :2] @ middle + sides[:, 2] <= -max(0.005, (high - low)[2] / 10)).all())


def _put_down(mesh: TexturedMesh, rng: np.random.Generator) -> _Placed:
    """Put a mesh on the origin with a random yaw: upright in two of three cases, otherwise on a stable side."""
    used = mesh.vertices[np.unique(mesh.faces)]
    hull = used[ConvexHull(used, qhull_options="QJ").vertices]
    sides = [turn for turn in SIDES if _rests(hull @ turn.T)]
    turn = sides[rng.integers(len(sides))] if sides and rng.random() < 1 / 3 else np.eye(3)
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ turn
    hull = hull @ matrix[:3, :3].T
    low, high = hull.min(axis=0), hull.max(axis=0)
    matrix[:3, 3] = -(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]
    footprint = hull[:, :2] + matrix[:2, 3]
    outline = ConvexHull(footprint, qhull_options="QJ")
    return _Placed(mesh.transformed(matrix), footprint[outline.vertices], outline.equations[:, :2])


def _in_line(new: _Placed, placed: Sequence[_Placed], towards: Array, rng: np.random.Generator) -> Iterator[Array]:
    """Return an iterator over positions [2] in line with a placed object and the camera; the taller one is in front."""
    anchor = placed[int(rng.integers(len(placed)))]
    middle = (anchor.corners.min(axis=0) + anchor.corners.max(axis=0)) / 2
    sideways = np.array([-towards[1], towards[0]])
    # Offset sideways, so that an object is rarely occluded completely.
    middle = middle + sideways * rng.choice([-1, 1]) * rng.uniform(0.15, 0.45) * np.ptp(anchor.corners @ sideways)
    forth = towards if new.height > anchor.height else -towards
    places = middle + (np.arange(0.0, 0.3, 0.006) + rng.uniform(0, 0.006))[:, None] * forth
    return itertools.takewhile(lambda place: np.linalg.norm(place) <= 1.3 * TABLE_RADIUS, places)


def _anywhere(rng: np.random.Generator) -> Iterator[Array]:
    """Yield random positions [2] on the table, within a radius that grows slowly, in case there is no space."""
    reach = TABLE_RADIUS
    while True:
        angle, radius = rng.uniform(0, 2 * np.pi), reach * np.sqrt(rng.random())
        yield radius * np.array([np.cos(angle), np.sin(angle)])
        reach *= 1.005


def _table() -> TexturedMesh:
    """Return a table: a square of 1.6 m at z = 0 with planks in slightly different greyish browns."""
    planks = np.random.default_rng(0).integers(-9, 10, (16, 1, 1))
    texture = (np.array([150, 138, 122]) + np.repeat(np.repeat(planks, 32, axis=0), 512, axis=1)).astype(np.uint8)
    texture[::32] = 96, 88, 78
    corner = np.array([[-0.8, -0.8, 0], [0.8, -0.8, 0], [0.8, 0.8, 0], [-0.8, 0.8, 0]])
    return TexturedMesh(corner, np.array(QUAD_FACES, np.int32), QUAD_UV, (texture,), np.zeros(2, np.int32))


def _sensed_depth(depth_m: Array, noise: float, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return depth [H, W] with the errors of a sensor, millimetres.

    The standard deviation of the axial noise is `noise` times 1.2 mm + 1.9 mm (z / m - 0.4)^2 (Nguyen, Izadi and Lovell
    2012). Depth is missing in 3 of 10 pixels at steps above `EDGE_STEP`, and everywhere beyond `MAX_SENSOR_DEPTH`.
    """
    sigma, near_edge = axial_deviation(depth_m), depth_edges(depth_m, EDGE_STEP)
    noisy = depth_m + noise * sigma * rng.standard_normal(depth_m.shape)
    lost = near_edge & (rng.random(depth_m.shape) < 0.3 * min(noise, 1.0))
    valid = (depth_m > 0) & (depth_m < MAX_SENSOR_DEPTH) & ~lost
    return np.where(valid, np.rint(noisy.clip(0.001) * 1000), 0).astype(np.uint16)


def compose_scene(
    objects: Mapping[str, TexturedMesh],
    rng: np.random.Generator,
    n_objects: int = 5,
    camera: Camera = SCENE_CAMERA,
    clutter: float = 0.85,
    noise: float = 1.0,
    light: float = 0.08,
) -> Scene:
    """Place random objects on a table and render them from 0.7 to 1.1 m with a camera pitch of 25 to 50 degrees.

    Args:
        objects: name -> mesh; metres, z up.
        rng: random number generator.
        n_objects: number of objects in the scene, each a different one.
        camera: camera of the frame.
        clutter: probability, in [0, 1], that an object is placed in line with another and the camera, so that one
            occludes the other.
        noise: factor of the sensor noise, at least 0; 0 gives no noise, 1 the noise of a consumer depth camera and a
            standard deviation of 2 in colour.
        light: variation of the light: a gain of all colours within 1 +- light, and one per channel within
            1 +- light / 4.

    Returns:
        The scene. An instance with fewer than `MIN_PIXELS` visible pixels is not labelled (its pixels are 0), so that
        there may be fewer than `n_objects` labels.

    Raises:
        InputError: there are fewer than `n_objects` objects.
    """
    meshes, _, pose = _composed(objects, n_objects, clutter, rng)
    return _render(meshes, pose, camera, noise, light, rng)


def compose_views(
    objects: Mapping[str, TexturedMesh],
    rng: np.random.Generator,
    n_objects: int = 5,
    n_views: int = 4,
    camera: Camera = SCENE_CAMERA,
    arc: float = 2 * np.pi,
    clutter: float = 0.85,
    noise: float = 1.0,
    light: float = 0.08,
    level: bool = False,
) -> list[tuple[Scene, NDArray[np.float64]]]:
    """Place random objects on a table and render them from cameras around it, at equal angles.

    An object has the same label in all views. The objects are placed in line as seen from the first camera.

    Args:
        objects: name -> mesh; metres, z up.
        rng: random number generator.
        n_objects: number of objects in the scene, each a different one.
        n_views: number of cameras.
        camera: camera of the frames.
        arc: angle over which the cameras are spaced, with none at its end, radians; by default a full circle.
        clutter: as in `compose_scene`.
        noise: as in `compose_scene`.
        light: as in `compose_scene`.
        level: whether all cameras have the height and the distance of the first camera, like a moving camera.

    Returns:
        For each camera, the scene as from `compose_scene` and the pose [4, 4], camera to world coordinates.

    Raises:
        InputError: there are fewer than `n_objects` objects.
    """
    meshes, azimuth, _ = _composed(objects, n_objects, clutter, rng)
    azimuths = azimuth + np.arange(n_views) * arc / n_views
    poses = (_random_pose(np.random.default_rng(0) if level else rng, each) for each in azimuths)
    return [(_render(meshes, pose, camera, noise, light, rng), pose) for pose in poses]


def _composed(
    objects: Mapping[str, TexturedMesh], count: int, clutter: float, rng: np.random.Generator
) -> tuple[dict[str, TexturedMesh], float, Array]:
    """Return random objects on the table, and the azimuth and pose of a camera in line with them.

    Raises:
        InputError: there are fewer than `count` objects.
    """
    if not 1 <= count <= len(objects):
        raise InputError(f"n_objects is {count!r}; it must be 1 to {len(objects)}, the number of objects")
    names = [list(objects)[k] for k in rng.choice(len(objects), count, replace=False)]
    azimuth = rng.uniform(0, 2 * np.pi)
    pose = _random_pose(rng, azimuth)
    towards = np.array([np.cos(azimuth), np.sin(azimuth)])
    placed: list[_Placed] = []
    for name in names:
        new = _put_down(objects[name], rng)
        in_line = _in_line(new, placed, towards, rng) if placed and rng.random() < clutter else ()
        places = itertools.chain(in_line, _anywhere(rng))
        place = next(each for each in places if all(new.apart(other, each) for other in placed))
        placed.append(_Placed(new.mesh.moved((*place, 0)), new.corners + place, new.normals))
    return dict(zip(names, (each.mesh for each in placed), strict=True)), azimuth, pose


def _random_pose(rng: np.random.Generator, azimuth: float) -> Array:
    """Return the pose of a camera that looks down on the table."""
    pitch = np.radians(rng.uniform(25, 50))
    return camera_pose(azimuth, np.pi / 2 - pitch, np.array([0, 0, 0.04]), rng.uniform(0.7, 1.1))


def _render(
    meshes: dict[str, TexturedMesh], pose: Array, camera: Camera, noise: float, light: float, rng: np.random.Generator
) -> Scene:
    """Render arranged objects; the last arguments are as in `compose_scene`."""
    rays = pixel_rays(camera.intrinsics, camera.height, camera.width, pose)
    hits = RayCaster([_table(), *meshes.values()]).cast(pose[:3, 3], rays)
    shape = (camera.height, camera.width)
    labels = hits.mesh.clip(0).astype(np.uint8 if len(meshes) < 256 else np.uint16).reshape(shape)
    truth, visible = {}, {}
    for label, (name, mesh) in enumerate(meshes.items(), 1):
        pixels = int((labels == label).sum())
        if pixels < MIN_PIXELS:
            labels[labels == label] = 0
            continue
        truth[label] = name
        visible[label] = pixels / int((RayCaster([mesh]).render(pose, camera).depth > 0).sum())

    depth = hits.distance.astype(np.float64).reshape(shape)
    color = np.where(hits.mesh[:, None] >= 0, hits.color, np.array([92, 96, 104])).reshape(*shape, 3)
    gain = rng.uniform(1 - light, 1 + light) * rng.uniform(1 - light / 4, 1 + light / 4, 3)
    lit = color * gain + noise * 2 * rng.standard_normal(color.shape, np.float32)
    seen = np.rint(lit).clip(0, 255).astype(np.uint8), _sensed_depth(depth, noise, rng)
    return Scene(RGBDFrame(*seen, labels, camera.intrinsics), truth, visible)
