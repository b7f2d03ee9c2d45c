"""Training clouds: their order, augmented copies, and golden clouds."""

from pathlib import Path

import numpy as np
from refusals import assert_refused
from scipy.spatial import cKDTree

from training.augmentation.augmentations import Augmentations
from training.augmentation.sensing import Illumination
from training.objects.builtin_objects import builtin_objects
from training.objects.meshes import find_meshes, load_mesh
from training.rendering.camera import camera_pose, view_angles
from training.views import mesh_views as views

OBJECTS = builtin_objects()
BALL = OBJECTS["tennis_ball"]


def test_all_views_of_all_objects_in_order() -> None:
    meshes = {"ball": BALL, "mug": OBJECTS["mug_blue"]}
    clouds = views.render_views(meshes, 120, 90)
    assert list(clouds) == list(meshes)
    for name, mesh in meshes.items():
        for cloud, angles in zip(clouds[name], view_angles(120, 90), strict=True):
            for part, expected in zip(cloud, views.view_cloud(mesh, camera_pose(*angles, mesh.centre)), strict=True):
                np.testing.assert_array_equal(part, expected, strict=True)
    assert_refused("^pose", views.view_cloud, BALL, camera_pose(0.0, 1.0, np.array([0, 0, 9.0])))


def test_copies_depend_only_on_name_view_and_seed() -> None:
    """Copies do not depend on the angles of the task, and the view itself is not augmented."""
    angles, augmentations = view_angles(90, 90), Augmentations(illumination=Illumination(), copies=2)
    whole = views.render_task(views.ViewTask("ball", BALL, angles, 0, augmentations, 7))
    assert [numbers for *numbers, _ in whole] == [[view, copy] for view in range(12) for copy in range(3)]
    part = views.render_task(views.ViewTask("ball", BALL, angles[5:7], 5, augmentations, 7))
    np.testing.assert_equal(part, whole[15:21])
    np.testing.assert_equal(views.render_task(views.ViewTask("ball", BALL, angles)), whole[::3])
    tasks = (("bowl", 0, 7), ("ball", 0, 8), ("ball", 1, 7))
    others = [views.render_task(views.ViewTask(n, BALL, angles[:1], k, augmentations, seed)) for n, k, seed in tasks]
    copies = [clouds[copy][2][1].tobytes() for clouds in (whole, *others) for copy in (1, 2)]
    assert len(set(copies)) == len(copies)


def test_golden_clouds(golden_files: tuple[Path, ...]) -> None:
    """Clouds agree to 1e-4 in all but about 1 % of their points, and everywhere to a voxel.

    Another ray caster may round a few depths to the adjacent millimetre, which moves, adds or removes points.
    """
    equal, total = 0, 0
    for path in golden_files:
        with np.load(path) as golden:
            points, colors, (azimuth, polar) = golden["points"], golden["colors"] * 255, golden["view"]
        name = path.stem.rpartition("_")[0]  # of a scan that stands beside the golden file
        mesh = OBJECTS.get(path.stem) or load_mesh(find_meshes(path.parents[1] / "data/meshes", {name: name})[name])
        xyz, rgb = views.view_cloud(mesh, camera_pose(azimuth, polar, mesh.centre))
        assert abs(len(xyz) - len(points)) <= 3 and (xyz.dtype, rgb.dtype) == (np.float32, np.uint8), path.name
        distance, nearest = cKDTree(points).query(xyz * views.SIGMA_S)
        same = distance < 1e-4
        equal, total = equal + int(same.sum()), total + len(xyz)
        assert distance.max() < views.DESCRIPTOR_VOXEL, path.name
        assert np.mean(same) > 0.92, path.name
        difference = np.abs(rgb - colors[nearest])
        assert difference[same].mean() < 0.5 and np.mean(difference > 2) < 0.03, path.name
    assert total > 1000 and equal / total > 0.97
