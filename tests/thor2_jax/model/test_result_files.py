"""Files with answers: COCO results read by pycocotools, BOP results, and the numbers of images and objects."""

from pathlib import Path

import numpy as np
import pytest
from image_files import patches, tilted
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from refusals import assert_refused

from thor2_jax.frames.frames import backproject
from thor2_jax.model.recognition import Recognition, detections_of
from thor2_jax.model.result_files import ResultTables, category_numbers, image_numbers

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools

FRAME = tilted(patches())
FRAME.depth[30:40] = 0
ANSWERS = [Recognition(3, "mug", 0.75), Recognition(7, "bowl", 0.5), Recognition(5, None, 0.125, reason="unknown")]


@pytest.mark.parametrize(("other", "image"), [("8/7", 2), ("9/8", 7)], ids=["several_scenes", "one_scene"])
def test_pycocotools_loads_the_results(other: str, image: int, tmp_path: Path) -> None:
    tables = ResultTables([other, "9/7"], ["bowl", "mug"])
    tables.add("9/7", FRAME, detections_of(FRAME, ANSWERS), 0.25)
    tables.write(coco=tmp_path / "results.json")
    dataset = COCO()
    images, categories = [{"id": image, "height": 240, "width": 320}], [{"id": 1}, {"id": 2}]
    dataset.dataset = {"images": images, "annotations": [], "categories": categories}
    dataset.createIndex()
    loaded = dataset.loadRes(str(tmp_path / "results.json"))
    annotations = {entry["category_id"]: entry for entry in loaded.loadAnns(loaded.getAnnIds())}
    assert set(annotations) == {1, 2}
    for category, answer in ((2, ANSWERS[0]), (1, ANSWERS[1])):
        mask = FRAME.label_image == answer.label
        entry = annotations[category]
        np.testing.assert_array_equal(loaded.annToMask(entry).astype(bool), mask)
        assert entry["score"] == answer.confidence and entry["area"] == mask.sum() and entry["image_id"] == image
        np.testing.assert_array_equal(entry["bbox"], coco_mask.toBbox(entry["segmentation"]))
        assert entry["frame"] == "9/7" and entry["category_name"] == answer.name
    assert annotations[2]["bbox"] == [20, 20, 70, 80]


def test_bop_lines(tmp_path: Path) -> None:
    tables = ResultTables(["000048/000007"], ["bowl", "mug"], {14: "mug"})
    tables.add("000048/000007", FRAME, detections_of(FRAME, ANSWERS), 0.25)
    tables.write(bop=tmp_path / "results.csv")
    header, line = (tmp_path / "results.csv").read_text().splitlines()
    assert header == "scene_id,im_id,obj_id,score,R,t,time" and tables.n_without_number == 1
    scene_id, im_id, obj_id, score, rotation, translation, seconds = line.split(",")
    assert (int(scene_id), int(im_id), int(obj_id), float(score), float(seconds)) == (48, 7, 14, 0.75, 0.25)
    np.testing.assert_array_equal(np.array(rotation.split(), float).reshape(3, 3), np.eye(3))
    points = backproject(FRAME.depth_m, FRAME.intrinsics)[(FRAME.label_image == 3) & (FRAME.depth_m > 0)]
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
