"""Composed scenes: frames agree with their labels, objects stand apart on the table, and noise is as documented."""

import numpy as np
import pytest
import trimesh
from refusals import assert_refused
from scipy.spatial import ConvexHull

from thor2_jax.frames.frames import Intrinsics, backproject
from training.objects.builtin_objects import builtin_objects
from training.rendering import scenes as module
from training.rendering.camera import Camera
from training.rendering.scenes import MIN_PIXELS, SCENE_CAMERA, Scene, compose_scene, compose_views

OBJECTS = builtin_objects()
SMALL = Camera(320, 240, Intrinsics(307.5, 307.5, 159.5, 119.5))


def scenes(n: int, **options: float) -> list[Scene]:
    return [compose_scene(OBJECTS, np.random.default_rng(seed), camera=SMALL, **options) for seed in range(n)]


def test_frame_and_truth_agree_and_are_seeded() -> None:
    one, same, other = (compose_scene(OBJECTS, np.random.default_rng(seed), len(OBJECTS)) for seed in (3, 3, 4))
    frame = one.frame
    assert frame.color.shape == (480, 640, 3) and frame.depth.dtype == np.uint16
    assert frame.intrinsics == SCENE_CAMERA.intrinsics
    assert set(frame.instances) == set(one.truth) == set(one.visible) <= {*range(1, len(OBJECTS) + 1)}
    assert len(OBJECTS) / 2 < len(one.truth) == len(set(one.truth.values()) & set(OBJECTS))
    assert 0 < min(one.visible.values()) < 0.5 and max(one.visible.values()) <= 1
    assert all((frame.labels == label).sum() >= MIN_PIXELS for label in one.truth)
    assert np.array_equal(frame.color, same.frame.color) and np.array_equal(frame.depth, same.frame.depth)
    assert one.truth == same.truth and not np.array_equal(frame.color, other.frame.color)
    for count in (0, 99):
        assert_refused(f"n_objects is {count};", compose_scene, OBJECTS, np.random.default_rng(0), n_objects=count)


def test_objects_lie_on_a_plane_in_their_own_colours() -> None:
    for scene in scenes(3, noise=0, light=0):
        depth = scene.frame.depth_m.astype(np.float64)
        points = backproject(depth, scene.frame.intrinsics)
        table = points[(scene.frame.labels == 0) & (depth > 0)]
        middle = table.mean(axis=0)
        normal = np.linalg.svd(table[::7] - middle, full_matrices=False)[2][2]
        normal *= -np.sign(normal @ middle)
        # A few pixels may belong to an object that is too occluded to be labelled.
        assert np.quantile(np.abs((table - middle) @ normal), 0.998) < 0.002
        pitch = np.degrees(np.arcsin(-normal[2]))
        assert 24.5 < pitch < 50.5
        assert 0.5 < depth[scene.frame.labels > 0].min() < 1.3
        for label, name in scene.truth.items():
            height = (points[scene.frame.labels == label] - middle) @ normal
            assert height.min() > -0.002 and 0.01 < height.max() < 0.25
            painted = {tuple(c) for texture in OBJECTS[name].textures for c in texture.reshape(-1, 3).tolist()}
            assert {tuple(c) for c in scene.frame.color[scene.frame.labels == label].tolist()} <= painted


def test_degrees_of_occlusion() -> None:
    for seed in range(3):  # an object alone is not occluded
        scene = compose_scene(OBJECTS, np.random.default_rng(seed), n_objects=1, camera=SMALL)
        assert scene.visible == {1: 1.0} and scene.occlusion(1) == "none"
    shares = {1: 1.0, 2: 0.96, 3: 0.95, 4: 0.71, 5: 0.7, 6: 0.01}
    graded = Scene(scene.frame, scene.truth, shares)
    assert [graded.occlusion(k) for k in shares] == ["none", "none", "low", "low", "high", "high"]


@pytest.mark.slow
def test_clutter_increases_occlusion() -> None:
    def occluded_share(clutter: float) -> float:
        visible = [share for scene in scenes(20, clutter=clutter) for share in scene.visible.values()]
        return float(np.mean(np.array(visible) <= 0.95))

    assert occluded_share(0.0) < 0.35 < occluded_share(1.0)
    degrees = [scene.occlusion(label) for scene in scenes(20) for label in scene.truth]
    assert all(degrees.count(degree) > 0.1 * len(degrees) for degree in ("none", "low", "high"))


def test_objects_stand_apart_on_the_table() -> None:
    for seed in range(4):
        objects = dict(list(OBJECTS.items())[seed::4])
        meshes = list(module._composed(objects, len(objects), 0.8, np.random.default_rng(seed))[0].values())
        for k, one in enumerate(meshes):
            assert one.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
            for other in meshes[k + 1 :]:
                # No vertex of one lies within the vertical prism over the footprint of the other.
                for a, b in ((one, other), (other, one)):
                    sides = ConvexHull(b.vertices[:, :2]).equations
                    assert ((a.vertices[:, :2] @ sides[:, :2].T + sides[:, 2]).max(axis=1) > 0.004).all()


def test_poses() -> None:
    """Poses are rigid motions; tall objects stand or lie, and no object balances on a tip."""
    rng = np.random.default_rng(0)
    names = ("soup_can_red", "cereal_box_blue", "screwdriver", "white_plate", "wooden_spoon")
    can, box, *flat = ({round(module._put_down(OBJECTS[name], rng).height, 3) for _ in range(60)} for name in names)
    assert can == {0.101, 0.066} and box == {0.235, 0.16, 0.055} and [len(heights) for heights in flat] == [1, 1, 1]
    mesh = OBJECTS["mug_blue"]
    moved = module._put_down(mesh, rng).mesh
    before, after = (np.linalg.norm(m.vertices[:-1] - m.vertices[1:], axis=1) for m in (mesh, moved))
    np.testing.assert_allclose(after, before, atol=1e-12)
    assert trimesh.Trimesh(moved.vertices, moved.faces).volume > 0


def test_noise_of_depth() -> None:
    rng = np.random.default_rng(0)
    for z in (0.6, 1.5, 3.0):
        depth = module._sensed_depth(np.full((200, 200), z), 1.0, rng)
        assert depth.mean() == pytest.approx(z * 1000, abs=0.3)
        expected = np.hypot(1.2 + 1.9 * (z - 0.4) ** 2, 1 / np.sqrt(12))
        assert depth.std() == pytest.approx(expected, rel=0.03)
    step = np.full((100, 100), 0.8)
    step[:, 50:] = 1.0
    depth = module._sensed_depth(step, 1.0, rng)
    assert (depth[:, :49] > 0).all() and (depth[:, 51:] > 0).all()
    assert 0.15 < (depth[:, 49:51] == 0).mean() < 0.45
    assert not module._sensed_depth(np.array([[0.0, 5.0], [0.0, 4.5]]), 1.0, rng).any()
    assert np.array_equal(module._sensed_depth(step, 0.0, rng), np.rint(step * 1000))


def test_light_changes_colours_by_a_gain() -> None:
    options = {"camera": SMALL, "noise": 0}
    plain, lit = (compose_scene(OBJECTS, np.random.default_rng(5), light=light, **options) for light in (0.0, 0.3))
    assert np.array_equal(plain.frame.labels, lit.frame.labels)
    bright = (plain.frame.color > 60).all(axis=-1) & (lit.frame.color < 255).all(axis=-1)
    gain = lit.frame.color[bright] / plain.frame.color[bright]
    assert np.ptp(gain, axis=0).max() < 0.02 and 0.6 < gain.min() <= gain.max() < 1.45


def test_views_of_a_scene_agree_in_space() -> None:
    views = compose_views(OBJECTS, np.random.default_rng(2), 4, 3, SMALL)
    assert len(views) == 3
    middles: dict[str, list[np.ndarray]] = {}
    for scene, pose in views:
        points = backproject(scene.frame.depth_m, scene.frame.intrinsics) @ pose[:3, :3].T + pose[:3, 3]
        for label, name in scene.truth.items():
            seen = points[(scene.frame.labels == label) & (scene.frame.depth > 0)]
            assert seen[:, 2].min() > -0.03
            if scene.visible[label] > 0.8:
                middles.setdefault(name, []).append((seen.min(axis=0) + seen.max(axis=0)) / 2)
    distances = [np.linalg.norm(a - b) for of_object in middles.values() for a in of_object for b in of_object]
    assert len(distances) > len(middles) and max(distances) < 0.06
