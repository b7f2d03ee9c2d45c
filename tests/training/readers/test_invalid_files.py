"""All dataset readers: frames are read one at a time, and errors name invalid files."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_files import READERS, K, vlg_item, write_dataset
from PIL import Image
from refusals import assert_refused

from training.readers.bop import BOP
from training.readers.ocid import OCID

FILES = {
    "bop": ("000049", "rgb/000001.png depth/000001.png mask_visib/000001_000000.png scene_camera.json scene_gt.json"),
    "ocid": ("table/top/mixed/seq36", "rgb/b.png depth/b.png label/b.png pcd/b.pcd"),
    "uwis": ("42/images", "000000_rgb.png 000000_depth.png 000000_labels.png 000000_poses.yaml"),
    "folder": ("b", "color.png depth.png mask.png intrinsics.json labels.json"),
}
"""Folder and files of the second of two frames."""
EACH_FILE = [(kind, f"{folder}/{file}") for kind, (folder, files) in FILES.items() for file in files.split()]
OPTIONAL = ("rgb", "camera", "labels.json")
"""Parts of the names of files without which there is no frame."""


@pytest.mark.parametrize("damage", ["missing", "empty", "cut off"])
@pytest.mark.parametrize(("kind", "file"), EACH_FILE)
def test_frames_before_a_damaged_file_are_read(kind: str, file: str, damage: str, tmp_path: Path) -> None:
    write_dataset(kind, tmp_path)
    path, whole = tmp_path / file, READERS[kind](tmp_path)
    assert path in whole.files(1) == whole.only(1).files(0) and all(each.is_file() for each in whole.files(1))
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        path.write_bytes(content[: 0 if damage == "empty" else int(0.4 * len(content))])
    elif any(part in file for part in OPTIONAL):
        return
    frames = iter(READERS[kind](tmp_path))
    assert next(frames).identifier == whole.identifiers[0]
    name = file.partition("/")[0]
    assert_refused(f"^{name}.*{path}{' is missing$' if damage == 'missing' else ''}", next, frames)


@pytest.mark.parametrize(
    ("kind", "file"), [("bop", "000049/mask_visib/000001_000000.png"), ("uwis", "42/images/000000_depth.png")]
)
def test_images_of_different_sizes(kind: str, file: str, tmp_path: Path) -> None:
    write_dataset(kind, tmp_path)
    Image.fromarray(np.zeros((5, 9), np.uint16 if "depth" in file else np.uint8)).save(tmp_path / file)
    assert_refused(r"\(5, 9\).*\((6, 9|720, 1280)\)", READERS[kind](tmp_path).__getitem__, 1)


@pytest.mark.parametrize("kind", FILES)
def test_paths_that_are_not_a_dataset(kind: str, tmp_path: Path) -> None:
    (tmp_path / "empty" / "41" / "images").mkdir(parents=True)
    (tmp_path / "file").touch()
    for name, expected in (("absent", "is not a directory"), ("file", "is not a directory"), ("empty", "has no ")):
        assert_refused(f"^(dataset|frames): {tmp_path / name} {expected}", READERS[kind], tmp_path / name)
    if kind in ("bop", "ocid"):
        write_dataset(kind, tmp_path)
        assert_refused("^names is 'a.x00b'; expected a path", BOP if kind == "bop" else OCID, tmp_path, "a\0b")


def camera(**changes: Any) -> dict[str, Any]:
    return {"1": {"cam_K": K, "depth_scale": 0.1, **changes}}


POSES = "42/images/000000_poses.yaml"


@pytest.mark.parametrize(
    ("kind", "file", "content", "expected"),
    [
        ("bop", "names.yaml", "8: mug\n", "obj_id 14"),
        ("bop", "names.yaml", "8: mug\n'08': bowl\n14: cup\n", "label 8"),
        ("bop", "names.yaml", "[mug]", ""),
        ("bop", "names.yaml", "8.0: mug", "'8.0' has the name 'mug'"),
        ("bop", "names.yaml", "8: ''", "8 has the name ''"),
        *(
            ("bop", f"000049/scene_{name}.json", content, expected)
            for content, expected in (("[]", ""), ({"2": []}, "no image 1"), ({"1": 7}, "entry is not"))
            for name in ("camera", "gt", "gt_info")
        ),
        ("bop", "000049/scene_camera.json", camera(cam_K=K[:8]), "intrinsics is ["),
        ("bop", "000049/scene_camera.json", camera(depth_scale="0.1"), "depth_scale is '0.1'"),
        ("bop", "000049/scene_gt.json", {"1": [{"obj_id": True}, {"obj_id": 8}]}, "obj_id is True"),
        ("bop", "000049/scene_gt_info.json", {"1": [{"visib_fract": None}] * 2}, "visib_fract is None"),
        ("bop", "000049/scene_gt_info.json", {"1": [{"visib_fract": 1}]}, "1 instances, scene_gt.json 2"),
        ("ocid", "names.json", "7", "holds a value of type int"),
        ("ocid", "names.json", {}, "lacks the sequences table/bottom/mixed/seq35, table/top/mixed/seq36"),
        ("ocid", "names.json", {"seq35": "mug"}, "seq35 is 'mug';"),
        ("ocid", "names.json", {"seq35": [""]}, "seq35 is [''];"),
        *(("ocid", "names.json", items, "lists no frame") for items in ([], [vlg_item(file="seq99,b.png")])),
        ("ocid", "names.json", [vlg_item(), vlg_item(target="")], "item 1 is"),
        *(("ocid", "names.json", [vlg_item(answer)], "item 0 is") for answer in ("mug", True)),
        ("ocid", "names.json", [vlg_item(file="seq36")], "item 0 is"),
        ("ocid", "names.json", [vlg_item(), vlg_item(target="bowl")], "the names 'mug' and 'bowl'"),
        ("uwis", POSES, "- mug\n", "holds a value of type list"),
        ("uwis", POSES, "mug: {pose: [1, 2, 3]}\n", "does not hold"),
        ("uwis", POSES, "mug: {label: true}\n", "label True has the name 'mug'"),
        ("uwis", POSES, "12: {label: 1}\n", "label 1 has the name 12"),
        ("uwis", POSES, "' ': {label: 1}\n", "label 1 has the name ' '"),
        ("uwis", POSES, "a: {label: 1}\nb: {label: 1}\n", "'a' and 'b'"),
        *(("folder", "b/labels.json", {"labels": names}, "is invalid") for names in (["mug"], {"1.0": "mug"})),
        ("folder", "b/labels.json", {"labels": {"1": None}}, "name None"),
        ("folder", "b/labels.json", {"labels": {"1": "mug", "01": "bowl"}}, "'mug' and 'bowl'"),
        ("folder", "b/labels.json", {"labels": {"7": "mug", "200": "can"}}, "has the labels 7, 200, but"),
    ],
)
def test_invalid_tables(kind: str, file: str, content: Any, expected: str, tmp_path: Path) -> None:
    write_dataset(kind, tmp_path)
    (tmp_path / file).write_text(content if isinstance(content, str) else json.dumps(content))
    assert_refused(f"{tmp_path / file}.*{re.escape(expected)}", lambda: list(READERS[kind](tmp_path)))
