"""The BOP reader on small datasets; images against OpenCV."""

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from commands import Command
from dataset_files import TWO, K, band, images, update, write_bop
from refusals import assert_refused
from toy_recognizers import NamesInOrder

from training.evaluation.runs import Run as EvaluatedRun
from training.readers.bop import BOP
from training.readers.frames import FrameFolder, find_frames


def test_a_frame(tmp_path: Path) -> None:
    scene = write_bop(tmp_path / "000048")
    (item,) = BOP(tmp_path)
    assert item.identifier == "000048/000001" and item.attributes == {"scene": "000048"}
    assert item.truth == {1: "obj_000008", 2: "obj_000014"}
    assert_refused("`thor2 evaluate bop` reads", FrameFolder, tmp_path)
    color = cv2.cvtColor(cv2.imread(str(scene / "rgb" / "000001.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(item.frame.color, color)
    depth = cv2.imread(str(scene / "depth" / "000001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(item.frame.depth, depth)
    np.testing.assert_allclose(item.frame.depth_m, depth * 0.1 / 1000, rtol=1e-6)  # depth_scale: millimetres per unit
    np.testing.assert_array_equal(item.frame.labels, TWO[8] * 1 + TWO[14] * 2)
    camera = item.frame.intrinsics
    assert (camera.fx, camera.cx, camera.fy, camera.cy) == (K[0], K[2], K[4], K[5])
    update(scene / "scene_camera.json", 1, {"cam_K": K, "depth_scale": 0.1, "distortion": [0.1, 0, 0, 0]})
    assert BOP(tmp_path)[0].frame.intrinsics.distortion == (0.1, 0, 0, 0)


def test_the_order_of_the_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (10, 2):
        write_bop(tmp_path / "000050", number, seed=number)
    write_bop(tmp_path / "000048", 1000000, suffix="jpg")
    write_bop(tmp_path / "000050", 2, suffix="jpg")  # replaced by the PNG
    write_bop(tmp_path / "000050", 2, seed=2)
    (tmp_path / "000050" / "rgb" / "notes.txt").write_text("")
    (tmp_path / "000050" / "rgb" / "cover.png").write_bytes(b"")
    (tmp_path / "models").mkdir()
    (tmp_path / "latest").symlink_to("000050")
    dataset = BOP(tmp_path)
    items = [pickle.loads(pickle.dumps(dataset.only(k)))[0] for k in range(len(dataset))]  # as in workers
    assert [item.identifier for item in items] == ["000048/1000000", "000050/000002", "000050/000010"]
    for item, seed in zip(items[1:], (2, 10), strict=True):
        np.testing.assert_array_equal(item.frame.color, images(seed)[0])
        np.testing.assert_array_equal(item.frame.depth, images(seed)[1])
    monkeypatch.chdir(tmp_path / "000048")
    assert BOP(".").identifiers == ["000048/1000000"]


def test_pixels_of_several_masks_belong_to_the_smallest(tmp_path: Path) -> None:
    """Pixels belong to the smallest mask, and among equal ones to the last."""
    objects = [(1, band(0, 6)), (2, band(2, 4)), (3, band(3, 8)), (4, band(6, 7)), (4, band(6, 7))]
    write_bop(tmp_path / "000048", objects=objects)
    (item,) = BOP(tmp_path)
    np.testing.assert_array_equal(item.frame.labels[0], [1, 1, 2, 2, 3, 3, 5, 3, 0])
    assert item.truth == {k + 1: f"obj_{obj_id:06d}" for k, (obj_id, _) in enumerate(objects)}


def test_instances_that_are_scored(tmp_path: Path) -> None:
    """As in BOP's evaluation, objects with less than a tenth visible are not scored; they still occlude others."""
    cases: list[tuple[Any, Any, list[int], tuple[int, ...]]] = [
        ({}, [], [], ()),
        ({8: band(0, 3), 14: band(0, 0)}, None, [1], (1,)),
        ({8: band(0, 3), 14: band(3, 4), 21: band(5, 6)}, [0.8, 0.0999, 0.1], [1, 3], (1, 2, 3)),
    ]
    for number, (objects, visible, scored, instances) in enumerate(cases):
        write_bop(tmp_path / f"{number}" / "000048", objects=objects, visible=visible)
        (item,) = BOP(tmp_path / f"{number}")
        assert list(item.truth) == scored and item.frame.instances == instances


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command, refused: Command) -> None:
    """There are two scenes; in the second, an object is almost hidden and one is absent, which needs no name."""
    runs = [EvaluatedRun("run", "0", NamesInOrder())]
    monkeypatch.setattr("training.evaluation.job.load_runs", lambda *_: runs)
    objects = [(14, band(0, 2)), (13, band(3, 5)), (14, band(6, 8))]
    write_bop(tmp_path / "test" / "000048", objects=objects, visible=[1, 1, 1])
    write_bop(tmp_path / "test" / "000049", objects=[*objects, (5, band(0, 0))], visible=[0.05, 1, 1, 0])
    (tmp_path / "names.yaml").write_text("13: bowl\n14: mug\n")
    command = ("evaluate", "bop", tmp_path / "test", "--model", tmp_path / "run")
    options = ("--names", tmp_path / "names.yaml", "--out", tmp_path / "report")
    assert "instances scored: 5" in printed(*command, *options)
    first, by_scene = json.loads((tmp_path / "report" / "report.json").read_text())["accuracy"]["max"]
    assert first["cells"][0]["accuracy"]["TOPS"]["mean"] == 0.6
    assert {cell["where"]["scene"]: cell["instances"] for cell in by_scene["cells"]} == {"000048": 3, "000049": 2}
    error = refused(*command, "--out", tmp_path / "other")  # without names, all objects are unknown
    assert "obj_000013, obj_000014, the runs have bowl, mug" in error and not (tmp_path / "other").exists()
    (tmp_path / "test" / "000049" / "rgb").rename(tmp_path / "rgb")
    assert "000049 has no scene_camera.json beside rgb" in refused(*command)


def test_a_scene_without_ground_truth_can_be_segmented(tmp_path: Path) -> None:
    scene = write_bop(tmp_path / "000048")
    for missing in ("mask_visib", "scene_gt.json"):
        shutil.move(scene / missing, tmp_path / f"moved_{missing}")
        (source,) = find_frames([tmp_path])
        frame = source.read()
        assert frame.labels is None and frame.depth.any()
        shutil.move(tmp_path / f"moved_{missing}", scene / missing)
    assert len(source.read().instances) == 2
    (source,) = find_frames([tmp_path], depth_scale=500)
    assert source.read().intrinsics.depth_scale == 500
