"""The BOP reader on small datasets and a real frame; images against OpenCV."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from dataset_files import TWO, K, band, color_and_depth, update, write_bop
from helpers import Command, NamesInOrder
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame
from training.evaluation.answering import answer_frames
from training.evaluation.results import compute_results
from training.evaluation.runs import Run as EvaluatedRun
from training.readers import BOP, FrameFolder


def error_message(root: Path, names: Path | None = None) -> str:
    with pytest.raises(InputError) as caught:
        list(BOP(root, names))
    return str(caught.value)


# Frames


def test_a_frame(tmp_path: Path) -> None:
    scene = write_bop(tmp_path / "000048")
    (item,) = BOP(tmp_path)
    assert item.identifier == "000048/000001" and item.attributes == {"scene": "000048"}
    assert item.truth == {1: "obj_000008", 2: "obj_000014"}
    np.testing.assert_array_equal(
        item.frame.color, cv2.cvtColor(cv2.imread(str(scene / "rgb" / "000001.png")), cv2.COLOR_BGR2RGB)
    )
    depth = cv2.imread(str(scene / "depth" / "000001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(item.frame.depth, depth)
    np.testing.assert_allclose(item.frame.depth_m, depth * 0.1 / 1000, rtol=1e-6)  # depth_scale: millimetres per unit
    np.testing.assert_array_equal(item.frame.labels, TWO[8] * 1 + TWO[14] * 2)
    camera = item.frame.intrinsics
    assert (camera.fx, camera.cx, camera.fy, camera.cy) == (K[0], K[2], K[4], K[5])


def test_the_order_of_the_images(tmp_path: Path) -> None:
    for number in (10, 2):
        write_bop(tmp_path / "000050", number, seed=number)
    write_bop(tmp_path / "000048", 1000000, suffix="jpg")
    (tmp_path / "000050" / "rgb" / "notes.txt").write_text("")
    (tmp_path / "000050" / "rgb" / "cover.png").write_bytes(b"")
    (tmp_path / "models").mkdir()
    dataset = BOP(tmp_path)
    assert len(dataset) == 3
    items = list(dataset)
    assert [item.identifier for item in items] == ["000048/1000000", "000050/000002", "000050/000010"]
    assert [item.identifier for item in dataset] == [item.identifier for item in items]
    for item, seed in zip(items[1:], (2, 10), strict=True):
        np.testing.assert_array_equal(item.frame.color, color_and_depth(seed)[0])
        np.testing.assert_array_equal(item.frame.depth, color_and_depth(seed)[1])
    jpeg = cv2.cvtColor(cv2.imread(str(tmp_path / "000048" / "rgb" / "1000000.jpg")), cv2.COLOR_BGR2RGB)
    np.testing.assert_allclose(items[0].frame.color.astype(int), jpeg.astype(int), atol=2)


def test_one_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(write_bop(tmp_path / "000048"))
    assert [item.identifier for item in BOP(".")] == ["000048/000001"]


def test_images_without_objects(tmp_path: Path) -> None:
    write_bop(tmp_path / "000048", objects={}, visible=[])
    (item,) = BOP(tmp_path)
    assert item.truth == {} and item.frame.instances == ()


# Masks


def test_pixels_of_several_masks_belong_to_the_smallest(tmp_path: Path) -> None:
    """Pixels belong to the smallest mask, and among equal ones to the last."""
    objects = [(1, band(0, 6)), (2, band(2, 4)), (3, band(3, 8)), (4, band(6, 7)), (4, band(6, 7))]
    write_bop(tmp_path / "000048", objects=objects)
    (item,) = BOP(tmp_path)
    np.testing.assert_array_equal(item.frame.labels[0], [1, 1, 2, 2, 3, 3, 5, 3, 0])
    assert item.truth == {k + 1: f"obj_{obj_id:06d}" for k, (obj_id, _) in enumerate(objects)}


@pytest.mark.parametrize("visible", [None, [0.5, 0.0]])
def test_masks_without_pixels_are_not_scored(tmp_path: Path, visible: list[float] | None) -> None:
    write_bop(tmp_path / "000048", objects={8: band(0, 3), 14: band(0, 0)}, visible=visible)
    (item,) = BOP(tmp_path)
    assert item.truth == {1: "obj_000008"} and item.frame.instances == (1,)


def test_objects_that_are_hardly_visible_are_not_scored(tmp_path: Path) -> None:
    """As in BOP's evaluation, objects with less than a tenth visible are not scored; they still occlude others."""
    write_bop(tmp_path / "000048", objects={8: band(0, 3), 14: band(3, 4), 21: band(5, 6)}, visible=[0.8, 0.0999, 0.1])
    (item,) = BOP(tmp_path)
    assert item.truth == {1: "obj_000008", 3: "obj_000021"}
    assert item.frame.instances == (1, 2, 3)


# Names


@pytest.mark.parametrize("name", ["names.yaml", "names.json"])
def test_names(tmp_path: Path, name: str) -> None:
    write_bop(tmp_path / "test" / "000048", objects=[(8, band(0, 2)), (14, band(3, 5)), (8, band(6, 8))])
    table = {8: "gelatin_box", 14: "mug", 21: "foam_brick"}
    (tmp_path / name).write_text(json.dumps(table) if name.endswith("json") else yaml.safe_dump(table))
    (item,) = BOP(tmp_path / "test", tmp_path / name)
    assert item.truth == {1: "gelatin_box", 2: "mug", 3: "gelatin_box"}


def test_objects_without_a_name(tmp_path: Path) -> None:
    names = tmp_path / "names.yaml"
    names.write_text("8: gelatin_box\n")
    write_bop(tmp_path / "000048", objects={8: band(0, 3), 14: band(0, 0)})
    assert [item.truth for item in BOP(tmp_path, names)] == [{1: "gelatin_box"}]  # 14 is not scored
    write_bop(tmp_path / "000048")
    assert f"000048/000001: {names} " in (message := error_message(tmp_path, names)) and "obj_id 14" in message


@pytest.mark.parametrize(
    "text",
    ["[mug]", "", "8: [mug", "8: 7", "8: ''", "8: null", "mug: 8", "true: mug", "8.0: mug", "-8: mug", "8: !!bool x"],
)
def test_invalid_names(tmp_path: Path, text: str) -> None:
    write_bop(tmp_path / "000048")
    names = tmp_path / "names.yaml"
    names.write_text(text)
    assert error_message(tmp_path, names).startswith(str(names))


# Files


@pytest.mark.parametrize(
    ("file", "whose"),
    [
        ("scene_gt.json", "000048"),
        ("depth/000001.png", "000048/000001"),
        ("mask_visib/000001_000001.png", "000048/000001"),
    ],
)
def test_files_that_are_missing(tmp_path: Path, file: str, whose: str) -> None:
    path = write_bop(tmp_path / "000048") / file
    path.unlink()
    assert error_message(tmp_path) == f"{whose}: {path} is missing"


@pytest.mark.parametrize(
    "file",
    [
        "rgb/000001.png",
        "depth/000001.png",
        "mask_visib/000001_000001.png",
        "scene_camera.json",
        "scene_gt.json",
        "scene_gt_info.json",
    ],
)
@pytest.mark.parametrize("kept", [0, 50])
def test_files_that_are_cut_off(tmp_path: Path, file: str, kept: int) -> None:
    path = write_bop(tmp_path / "000048", visible=[1.0, 1.0]) / file
    path.write_bytes(path.read_bytes()[:kept])
    assert str(path) in error_message(tmp_path)


def test_frames_are_read_one_at_a_time(tmp_path: Path) -> None:
    write_bop(tmp_path / "000048")
    (write_bop(tmp_path / "000049") / "scene_gt.json").write_text("damaged")
    frames = iter(BOP(tmp_path))
    assert next(frames).identifier == "000048/000001"
    with pytest.raises(InputError, match="^000049: "):
        next(frames)


@pytest.mark.parametrize(("file", "name"), [("depth/000001.png", "depth"), ("mask_visib/000001_000000.png", "depth")])
def test_images_of_different_sizes(tmp_path: Path, file: str, name: str) -> None:
    path = write_bop(tmp_path / "000048") / file
    Image.fromarray(np.zeros((5, 9), np.uint16 if name in file else np.uint8)).save(path)
    message = error_message(tmp_path)
    assert "(5, 9)" in message and "(6, 9)" in message


def test_color_images_as_masks_are_refused(tmp_path: Path) -> None:
    path = write_bop(tmp_path / "000048") / "mask_visib" / "000001_000000.png"
    Image.fromarray(color_and_depth()[0]).save(path)
    assert f"{path} has shape (6, 9, 3)" in error_message(tmp_path)


@pytest.mark.parametrize("file", ["scene_camera.json", "scene_gt.json", "scene_gt_info.json"])
@pytest.mark.parametrize(
    "table", [None, [], {}, {"000001": []}, {"2": []}, {"1": None}, {"1": 7}, {"1": [7]}, {"1": [{}]}]
)
def test_invalid_tables(tmp_path: Path, file: str, table: Any) -> None:
    path = write_bop(tmp_path / "000048", visible=[1.0, 1.0]) / file
    path.write_text(json.dumps(table))
    assert str(path) in error_message(tmp_path)


@pytest.mark.parametrize("text", ["[" * 100_000, "\xff", '{"1": [], }'])
def test_tables_that_are_not_json(tmp_path: Path, text: str) -> None:
    path = write_bop(tmp_path / "000048") / "scene_gt.json"
    path.write_bytes(text.encode("latin-1"))
    assert error_message(tmp_path).startswith(f"000048: {path} is damaged (")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"cam_K": K[:8]}, "intrinsics is ["),
        ({"cam_K": None}, "intrinsics is None"),
        ({"cam_K": [K[:3], K[3:6]]}, "intrinsics is [["),
        ({"cam_K": [1066.8, 0.5, *K[2:]]}, "intrinsics is [1066.8, 0.5,"),
        ({"cam_K": [*K[:8], 2.0]}, "fx, 0, cx"),
        ({"cam_K": [-1.0, *K[1:]]}, "intrinsics.fx is -1.0"),
        ({"cam_K": [float("nan"), *K[1:]]}, "intrinsics.fx is nan"),
        ({"cam_K": ["1066", *K[1:]]}, "intrinsics.fx is '1066'"),
        ({"depth_scale": 0}, "depth_scale is 0"),
        ({"depth_scale": -0.1}, "depth_scale is -0.1"),
        ({"depth_scale": float("inf")}, "depth_scale is inf"),
        ({"depth_scale": float("nan")}, "depth_scale is nan"),
        ({"depth_scale": "0.1"}, "depth_scale is '0.1'"),
        ({"depth_scale": 10**400}, "depth_scale is 1000"),
    ],
)
def test_invalid_cameras(tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    path = write_bop(tmp_path / "000048") / "scene_camera.json"
    path.write_text(json.dumps({"1": {"cam_K": K, "depth_scale": 0.1, **change}}))
    message = error_message(tmp_path)
    assert message.startswith(f"000048/000001: {path}: ") and expected in message


@pytest.mark.parametrize(
    ("file", "entry", "expected"),
    [
        ("scene_gt.json", [{"obj_id": "8"}, {"obj_id": 14}], "obj_id is '8'"),
        ("scene_gt.json", [{"obj_id": 8}, {"obj_id": 14.0}], "obj_id is 14.0"),
        ("scene_gt.json", [{"obj_id": True}, {"obj_id": 14}], "obj_id is True"),
        ("scene_gt_info.json", [{"visib_fract": None}, {"visib_fract": 1}], "visib_fract is None"),
        ("scene_gt_info.json", [{"visib_fract": 1}], "1 instances in image 1"),
    ],
)
def test_invalid_instances(tmp_path: Path, file: str, entry: Any, expected: str) -> None:
    path = write_bop(tmp_path / "000048", visible=[1.0, 1.0]) / file
    path.write_text(json.dumps({"1": entry}))
    message = error_message(tmp_path)
    assert str(path) in message and expected in message


@pytest.mark.parametrize(
    "damage",
    [
        lambda scene: (scene / "scene_camera.json").unlink(),
        lambda scene: (scene / "rgb").rename(scene / "gray"),
        lambda scene: (scene / "rgb" / "000001.png").rename(scene / "rgb" / "first.png"),
    ],
)
def test_directories_that_are_not_a_dataset(tmp_path: Path, damage: Callable[[Path], object]) -> None:
    damage(write_bop(tmp_path / "000048"))
    for path, expected in ((tmp_path, "has no scene_camera.json"), (tmp_path / "absent", "is not a directory")):
        assert error_message(path).startswith(f"dataset: {path} {expected}")


# Real frames


def test_a_real_frame(shared: Path, tmp_path: Path) -> None:
    """A frame of YCB-Video in BOP's format, with depth in tenths of a millimetre, is read unchanged.

    The origins of its objects, at the poses of the dataset, lie within the boxes of their masks.
    """
    folder = shared / "data" / "frames" / "ycbv_real_0000"
    if not folder.is_dir():
        pytest.skip("no real frames beside the checkout")
    real = next(iter(FrameFolder(folder)))
    poses = json.loads((folder / real.identifier / "labels.json").read_text())["poses_cam_from_ycbv_model"]
    scene = write_bop(tmp_path / "000000", objects={label: real.frame.labels == label for label in real.truth})
    k = real.frame.intrinsics
    matrix = [k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1]
    update(scene / "scene_camera.json", 1, {"cam_K": matrix, "depth_scale": 0.1})
    Image.fromarray(real.frame.color).save(scene / "rgb" / "000001.png")
    Image.fromarray(real.frame.depth * np.uint16(10)).save(scene / "depth" / "000001.png")
    (tmp_path / "names.json").write_text(json.dumps(real.truth))
    (item,) = BOP(tmp_path, tmp_path / "names.json")
    np.testing.assert_array_equal(item.frame.color, real.frame.color)
    np.testing.assert_allclose(item.frame.depth_m, real.frame.depth_m, rtol=1e-6)
    assert sorted(item.truth.values()) == sorted(real.truth.values())
    for label, name in item.truth.items():
        (original,) = (number for number, other in real.truth.items() if other == name)
        np.testing.assert_array_equal(item.frame.labels == label, real.frame.labels == original)
        x, y, z = np.array(poses[name])[:, 3]
        intrinsics = item.frame.intrinsics
        row, column = np.nonzero(item.frame.labels == label)
        assert column.min() <= intrinsics.cx + intrinsics.fx * x / z <= column.max()
        assert row.min() <= intrinsics.cy + intrinsics.fy * y / z <= row.max()


# To the end


class LastIsSmall(NamesInOrder):
    """The last instance of a frame is too small."""

    def reason(self, label: int, frame: RGBDFrame) -> str | None:
        return "too few points" if label == frame.instances[-1] else None


def write_dataset(root: Path) -> Path:
    """Two scenes of three objects; in the second the first object is almost hidden."""
    objects = [(14, band(0, 2)), (13, band(3, 5)), (14, band(6, 8))]
    write_bop(root / "test" / "000048", objects=objects, visible=[1, 1, 1])
    write_bop(root / "test" / "000049", objects=objects, visible=[0.05, 1, 1])
    (root / "names.yaml").write_text("13: bowl\n14: mug\n")
    return root / "test"


def test_accuracy_by_scene(tmp_path: Path) -> None:
    dataset = BOP(write_dataset(tmp_path), tmp_path / "names.yaml")
    run = EvaluatedRun("run", "", LastIsSmall())  # type: ignore[arg-type]
    answers = [answers for _, answers in answer_frames([run], dataset)]
    assert [(frame.frame, i.label, i.truth) for frame in answers for i in frame.instances] == [
        ("000048/000001", 1, "mug"),
        ("000048/000001", 2, "bowl"),
        ("000048/000001", 3, "mug"),
        ("000049/000001", 2, "bowl"),
        ("000049/000001", 3, "mug"),
    ]
    results = compute_results("bop", [run], answers)
    first, by_scene = results["accuracy"]["max"]
    assert first["cells"][0]["accuracy"]["TOPS"]["mean"] == 0.6
    assert sum(results["instances"]["not_described"].values()) == 2
    assert {cell["where"]["scene"]: cell["instances"] for cell in by_scene["cells"]} == {"000048": 3, "000049": 2}


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command, refused: Command) -> None:
    runs = [EvaluatedRun("run", "0", LastIsSmall())]
    monkeypatch.setattr("training.evaluation.answering.load_runs", lambda paths: runs)
    dataset, model = write_dataset(tmp_path), ("--model", tmp_path / "run")
    options = ("--names", tmp_path / "names.yaml", "--out", tmp_path / "report")
    assert "5 instances scored" in printed("evaluate", "bop", dataset, *model, *options)
    assert json.loads((tmp_path / "report" / "report.json").read_text())["instances"]["scored"] == 5
    error = refused("evaluate", "bop", dataset, *model, at_once=False)  # without names, all objects are unknown
    assert "obj_000013, obj_000014, the runs know bowl, mug" in error
    error = refused("evaluate", "bop", tmp_path / "absent", *model)
    assert error == f"error: dataset: {tmp_path / 'absent'} is not a directory; expected a dataset"
