"""Files with answers: COCO results read by pycocotools, BOP results, and the numbers of images and objects."""

from pathlib import Path

import numpy as np
import pytest
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from refusals import assert_refused

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject
from thor2_jax.model.recognition import Recognition, detections_of
from thor2_jax.model.result_files import ResultTables, category_numbers, image_numbers

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools

RNG = np.random.default_rng(0)


def frame() -> RGBDFrame:
    labels = np.zeros((40, 60), np.uint8)
    labels[5:20, 10:30], labels[0:8, 40:60], labels[30, 7] = 1, 2, 3
    depth = RNG.integers(500, 900, labels.shape).astype(np.uint16)
    depth[6:9] = 0
    return RGBDFrame(RNG.integers(0, 256, (40, 60, 3), dtype=np.uint8), depth, labels, Intrinsics(60, 61, 30, 20))


ANSWERS = [Recognition(1, "mug", 0.75), Recognition(2, "bowl", 0.5), Recognition(3, None, 0.125, reason="unknown")]


def test_pycocotools_loads_the_results(tmp_path: Path) -> None:
    scene, tables = frame(), ResultTables(["8/7", "9/7"], ["bowl", "mug"])
    tables.add("9/7", scene, detections_of(scene, ANSWERS), 0.25)
    tables.write(coco=tmp_path / "results.json")
    dataset = COCO()
    images, categories = [{"id": 2, "height": 40, "width": 60}], [{"id": 1}, {"id": 2}]
    dataset.dataset = {"images": images, "annotations": [], "categories": categories}
    dataset.createIndex()
    loaded = dataset.loadRes(str(tmp_path / "results.json"))
    annotations = {entry["category_id"]: entry for entry in loaded.loadAnns(loaded.getAnnIds())}
    assert set(annotations) == {1, 2}
    for category, label, score in ((2, 1, 0.75), (1, 2, 0.5)):
        mask = scene.label_image == label
        entry = annotations[category]
        np.testing.assert_array_equal(loaded.annToMask(entry).astype(bool), mask)
        assert entry["score"] == score and entry["area"] == mask.sum() and entry["image_id"] == 2
        np.testing.assert_array_equal(entry["bbox"], coco_mask.toBbox(entry["segmentation"]))
        assert entry["frame"] == "9/7" and entry["category_name"] == ANSWERS[label - 1].name
    assert annotations[2]["bbox"] == [10, 5, 20, 15]


def test_bop_lines(tmp_path: Path) -> None:
    scene, tables = frame(), ResultTables(["000048/000007"], ["bowl", "mug"], {14: "mug"})
    tables.add("000048/000007", scene, detections_of(scene, ANSWERS), 0.25)
    tables.write(bop=tmp_path / "results.csv")
    header, line = (tmp_path / "results.csv").read_text().splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time" and tables.n_without_number == 1
    scene_id, im_id, obj_id, score, rotation, translation, seconds = line.split(",")
    assert (int(scene_id), int(im_id), int(obj_id), float(score), float(seconds)) == (48, 7, 14, 0.75, 0.25)
    np.testing.assert_array_equal(np.array(rotation.split(), float).reshape(3, 3), np.eye(3))
    points = backproject(scene.depth_m, scene.intrinsics)[(scene.label_image == 1) & (scene.depth_m > 0)]
    np.testing.assert_allclose(np.array(translation.split(), float), 1000 * points.mean(axis=0), atol=0.01)


def test_image_numbers() -> None:
    assert image_numbers(["000048/000001", "000048/000036", "000049/000001"]) == [(48, 1), (48, 36), (49, 1)]
    assert image_numbers(["000007", "000003"]) == [(1, 7), (1, 3)]
    assert image_numbers(["a", "000003"]) == [(1, 1), (1, 2)]
    assert image_numbers(["day/3", "night/3"]) == [(1, 1), (1, 2)]
    assert image_numbers(["3", "03"]) == [(1, 1), (1, 2)]
    assert image_numbers(["x/000048/2"]) == [(48, 2)]
    assert image_numbers([]) == []


def test_category_numbers() -> None:
    assert category_numbers(["bowl", "mug"]) == {"bowl": 1, "mug": 2}
    assert category_numbers(["obj_000012", "obj_000003"]) == {"obj_000012": 12, "obj_000003": 3}
    assert category_numbers(["obj_000012", "mug"]) == {"obj_000012": 1, "mug": 2}
    assert category_numbers(["obj_12", "obj_012"]) == {"obj_12": 1, "obj_012": 2}
    assert category_numbers(["bowl", "mug"], {14: "mug", 15: "fork"}) == {"mug": 14}
    assert category_numbers([]) == {}
    assert category_numbers(["mug"], {1: "fork", 2: "fork", 3: "mug"}) == {"mug": 3}
    assert_refused("several numbers of 'mug'", category_numbers, ["mug"], {1: "mug", 2: "mug"})
