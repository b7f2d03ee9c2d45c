"""UW-IS Occluded and folders of frames, on small datasets with the layout of the real ones, and recordings."""

import functools
import weakref
from pathlib import Path

import numpy as np
import pytest
from dataset_files import images, write_folder, write_uwis
from recording_files import table_frame, write_recording
from refusals import assert_refused

from thor2_jax.frames.frames import Intrinsics
from thor2_jax.recordings.bags import Bag
from training.readers.frames import FrameFolder, find_frames, recorded_sources
from training.readers.labelled import LabelledFrame
from training.readers.uwis import UWISOccluded, video_attributes

# The dataset's table, in three columns for the degrees of occlusion: none, low, high.
VIDEOS = {
    ("kitchen", "1"): "41 42 176 177 | 44 45 179 180 | 46 48 182 183",
    ("food", "1"): "32 33 167 168 | 35 36 170 171 | 38 39 173 174",
    ("tools", "1"): "50 51 185 186 | 53 54 188 189 | 56 57 191 192",
    ("kitchen", "2"): "68 69 203 204 | 71 72 206 207 | 74 75 209 210",
    ("food", "2"): "77 78 212 213 | 80 81 215 216 | 83 84 218 219",
    ("tools", "2"): "59 60 194 195 | 62 63 197 198 | 65 66 200 201",
}
MUG = "mug:\n  label: 1\n  pose: [1, 0, 0]\n"


def assert_images_of(item: LabelledFrame, expected: tuple[np.ndarray, ...]) -> None:
    for image, values in zip((item.frame.color, item.frame.depth, item.frame.labels), expected, strict=True):
        np.testing.assert_array_equal(image, values)


def test_uwis_frames_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    """Some objects are not scored; others are, though they are fully occluded."""
    not_scored = "".join(f"{name}: {{label: {k}}}\n" for k, name in enumerate(("ice_cream", "hot_sauce", "chips_can")))
    write_uwis(tmp_path, "1000", "000000", not_scored + MUG + "spoon: {label: 77}\n")
    write_uwis(tmp_path, "219", "000010", MUG, seed=1)
    write_uwis(tmp_path, "219", "000002", MUG, seed=2)
    (tmp_path / "README.md").write_text("nothing to read")
    dataset = UWISOccluded(tmp_path)
    items = list(dataset)
    assert [item.identifier for item in items] == ["219/000002", "219/000010", "1000/000000"] == dataset.identifiers
    assert [item.truth for item in items] == [{1: "mug"}, {1: "mug"}, {1: "mug", 77: "spoon"}]
    assert list(dataset.names()) == ["mug", "mug", "mug", "spoon"]
    for item, seed in zip(items, (2, 1, 0), strict=True):
        assert_images_of(item, images(seed, (720, 1280)))
        camera = 920.458618164062, 921.807800292969, 626.486083984375, 358.848205566406
        assert item.frame.intrinsics == Intrinsics(*camera, 1000, 1280, 720)
    listed = {"environment": "lounge", "category": "food", "occlusion": "high", "light": "2"}
    assert [item.attributes for item in items] == [listed, listed, {"environment": "lounge"}]


def test_uwis_attributes() -> None:
    for (category, light), columns in VIDEOS.items():
        for occlusion, numbers in zip(("none", "low", "high"), columns.split("|"), strict=True):
            expected = {"category": category, "occlusion": occlusion, "light": light}
            for number in map(int, numbers.split()):
                environment = "warehouse" if number < 167 else "lounge"
                assert video_attributes(number) == {"environment": environment, **expected}
    assert video_attributes(47) == {"environment": "warehouse"}


def test_a_folder_of_frames(tmp_path: Path) -> None:
    write_folder(tmp_path / "b", {"labels": {"1": "mug", "200": "bowl"}, "kind": "real"}, seed=1)
    write_folder(tmp_path / "a", {"labels": {}}, seed=2)
    (tmp_path / "c").mkdir()
    (tmp_path / "index.json").write_text("{}")
    assert FrameFolder(tmp_path).note == ""
    (write_folder(tmp_path / "d", {}) / "labels.json").unlink()
    dataset = FrameFolder(tmp_path)
    assert dataset.identifiers == ["a", "b"] and dataset.note == "frames without labels.json: 1 (d)"
    items = list(dataset)
    assert [item.truth for item in items] == [{}, {1: "mug", 200: "bowl"}]
    for item, seed in zip(items, (2, 1), strict=True):
        assert_images_of(item, images(seed))
        assert item.attributes == {} and item.frame.intrinsics.fy == 601


def test_one_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_folder(tmp_path / "only", {"labels": {"1": "mug"}})
    monkeypatch.chdir(folder)
    (folder / "sub").mkdir()
    for path in (folder, ".", "sub/.."):
        assert FrameFolder(path).identifiers == ["only"]


def test_frames_of_one_name_in_two_folders(tmp_path: Path) -> None:
    for folder in ("a", "b/deep"):
        write_folder(tmp_path / folder / "000", {"labels": {"1": "mug"}})
    for paths, names in (
        (("a", "b"), ["000", "deep/000"]),
        (("a/000", "b/deep/000"), ["a/000", "b/deep/000"]),
        (("a", "b/deep"), ["a/000", "b/deep/000"]),
    ):
        assert [source.name for source in find_frames([tmp_path / path for path in paths])] == names
    for again in ("b", "b/deep"):
        assert_refused("000 is given twice", find_frames, [tmp_path / "b", tmp_path / again])


def test_frames_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    names = ["1-2/frame", "1-10/frame", "2a", "2b", "02c", "10", "x9/y2", "x9/y10", "x10"]
    for name in names:
        write_folder(tmp_path / name, {})
    assert [source.name for source in find_frames([tmp_path])] == names


RECORDED = [table_frame(k) for k in range(3)]


@pytest.mark.parametrize("every", [1, 2])
def test_frames_are_read_in_any_order(tmp_path: Path, every: int) -> None:
    path = write_recording(tmp_path / "a.mcap", RECORDED)
    opened: list[weakref.ref[Bag]] = []

    def open_bag() -> Bag:
        bag = Bag(path)
        opened.append(weakref.ref(bag))
        return bag

    sources, notes = recorded_sources(open_bag, every)
    assert not notes
    assert len({source.name for source in sources}) == len(sources) == len(RECORDED[::every])
    for number in (len(sources) - 1, 0, 1, 1, 0, 1):
        frame, expected = sources[number].read(), RECORDED[::every][number]
        np.testing.assert_array_equal(frame.color, expected.color)
        assert frame.labels is None
    hidden = path.rename(tmp_path / "hidden")  # a start that fails is repeated by the next read
    with pytest.raises(FileNotFoundError):
        sources[0].read()
    hidden.rename(path)
    np.testing.assert_array_equal(sources[-1].read().color, RECORDED[::every][-1].color)
    del sources
    assert opened and all(bag() is None for bag in opened)  # closed at once, not by a later garbage collection


def test_a_damaged_recording_has_the_frames_before(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap", [table_frame(k) for k in range(8)])
    path.write_bytes(path.read_bytes()[: -(10**6)])
    sources, (note,) = recorded_sources(functools.partial(Bag, path))
    assert "mcap recover" in note and 2 < len(sources) < 8
    assert f"truncated after {len(sources)} colour images" in note
    for k, source in enumerate(sources):
        np.testing.assert_array_equal(source.read().depth, table_frame(k).depth)
    for content, message in ((b"damaged", "damaged"), (path.read_bytes()[:2000], "truncated after 0 colour images")):
        (tmp_path / "b.mcap").write_bytes(content)
        assert_refused(message, recorded_sources, functools.partial(Bag, tmp_path / "b.mcap"))
