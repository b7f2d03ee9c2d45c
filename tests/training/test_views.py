"""Training clouds against analytic surfaces and against clouds of real scans from the released pipeline."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from thor2_jax.errors import InputError
from training.meshes import TexturedMesh, find_meshes, load_mesh
from training.view_sphere import DISTANCE, camera_pose, view_angles
from training.views import MIN_POINTS, SIGMA_S, VOXEL, iterate_views, view_cloud

GOLDEN = ["004_sugar_box", "006_mustard_bottle", "025_mug", "048_hammer", "055_baseball", "061_foam_brick"]


def ball(radius: float = 0.05) -> TexturedMesh:
    shape = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    colors = np.where(shape.vertices[:, 2:] > 0, [220, 40, 30], [20, 60, 200]).astype(np.uint8)
    return TexturedMesh(np.array(shape.vertices), np.array(shape.faces, np.int32), corner_colors=colors[shape.faces])


def test_points_lie_on_the_sphere_with_its_colours() -> None:
    pose = camera_pose(0.4, 1.2, np.zeros(3))
    xyz, rgb = view_cloud(ball(), pose)
    assert xyz.dtype == np.float32 and rgb.dtype == np.uint8 and xyz.shape == rgb.shape
    assert len(xyz) > 300
    # A voxel's mean lies inside the curved surface by a fraction of the voxel.
    radius = np.linalg.norm(xyz - [0, 0, DISTANCE], axis=1)
    assert np.abs(radius - 0.05).max() < 0.003
    world = xyz @ pose[:3, :3].T + pose[:3, 3]
    assert (rgb[world[:, 2] > 0.006] == [220, 40, 30]).all()
    assert (rgb[world[:, 2] < -0.006] == [20, 60, 200]).all()


def test_one_point_a_voxel() -> None:
    xyz, _ = view_cloud(ball(), camera_pose(0.4, 1.2, np.zeros(3)))
    voxel = VOXEL / SIGMA_S
    # The grid starts half a voxel below the least coordinate of the points, which the means only come near.
    cells = np.floor((xyz - xyz.min(axis=0)) / voxel).astype(int)
    assert len(np.unique(cells, axis=0)) > 0.6 * len(xyz)
    surface = 2 * np.pi * 0.05**2 / voxel**2
    assert 0.4 * surface < len(xyz) < 1.2 * surface


def test_nothing_seen() -> None:
    with pytest.raises(InputError, match="sees nothing"):
        view_cloud(ball(), camera_pose(0.0, 1.0, np.array([0, 0, 9.0])))


def test_views_in_order_whatever_the_number_of_workers() -> None:
    angles = view_angles(120, 90)
    meshes = {"ball": ball(), "speck": ball(0.004)}
    alone = list(iterate_views(meshes, angles))
    assert [view.name for view in alone] == ["ball"] * 9 + ["speck"] * 9
    assert np.array_equal([[view.azimuth, view.polar] for view in alone], np.tile(angles, (2, 1)))
    assert not any(view.sparse for view in alone[:9])
    assert all(view.sparse and len(view.xyz) < MIN_POINTS for view in alone[9:])
    xyz, rgb = view_cloud(meshes["ball"], camera_pose(*angles[4], np.zeros(3)))
    assert np.array_equal(alone[4].xyz, xyz) and np.array_equal(alone[4].rgb, rgb)


@pytest.mark.slow
def test_workers_give_the_same_views() -> None:
    angles = view_angles(20, 15)
    alone, shared_out = (list(iterate_views({"a": ball(), "b": ball(0.03)}, angles, n)) for n in (1, 2))
    assert len(alone) == len(shared_out) == 2 * len(angles)
    for one, other in zip(alone, shared_out, strict=True):
        assert (one.name, one.azimuth, one.polar) == (other.name, other.azimuth, other.polar)
        assert np.array_equal(one.xyz, other.xyz) and np.array_equal(one.rgb, other.rgb)


def test_no_meshes_and_no_workers() -> None:
    assert list(iterate_views({}, view_angles(180, 90))) == []
    with pytest.raises(InputError, match="workers must be at least 1, not 0"):
        iterate_views({"ball": ball()}, view_angles(180, 90), 0)


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_clouds(shared: Path, name: str) -> None:
    """Other ray tracers round a few depths to the other millimetre, which moves a point, or adds or takes one away.

    So the clouds agree to 1e-4 in all but a hundredth of their points or so, and everywhere to a voxel.
    """
    mesh = load_mesh(find_meshes(shared / "data" / "meshes", {name: name})[name])
    equal, total = 0, 0
    for path in sorted((shared / "golden").glob(f"{name}_?.npz")):
        with np.load(path) as golden:
            points, colors, (azimuth, polar) = golden["points"], golden["colors"] * 255, golden["view"]
        xyz, rgb = view_cloud(mesh, camera_pose(azimuth, polar, mesh.centre))
        assert abs(len(xyz) - len(points)) <= 3
        distance, nearest = cKDTree(points).query(xyz * SIGMA_S)
        same = distance < 1e-4
        equal, total = equal + int(same.sum()), total + len(xyz)
        assert distance.max() < VOXEL
        assert np.mean(same) > 0.92
        difference = np.abs(rgb - colors[nearest])
        assert difference[same].mean() < 0.5 and np.mean(difference > 2) < 0.03
    assert total > 1000 and equal / total > 0.97
