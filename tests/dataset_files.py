"""Small datasets that tests write in the layouts of BOP, OCID, UW-IS Occluded and of folders of frames."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from image_files import write_frame_files
from PIL import Image

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject
from training.readers.bop import BOP
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrames
from training.readers.ocid import OCID
from training.readers.uwis import UWISOccluded

SHAPE = (6, 9)
K = [1066.778, 0.0, 4.9869, 0.0, 1067.487, 2.3109, 0.0, 0.0, 1.0]
"""Intrinsics of YCB-Video with the principal point moved into the small images."""


def images(seed: int, shape: tuple[int, int] = SHAPE) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    color = rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    depth = rng.integers(300, 2500, SHAPE, dtype=np.uint16)
    small = color, depth, rng.integers(0, 3, SHAPE, dtype=np.uint8)
    return tuple(np.resize(image, (*shape, *image.shape[2:])) for image in small)


def band(start: int, stop: int) -> np.ndarray:
    """Return the mask of a range of columns."""
    mask = np.zeros(SHAPE, bool)
    mask[:, start:stop] = True
    return mask


TWO = {8: band(0, 3), 14: band(4, 7)}


def update(path: Path, number: int, entry: Any) -> None:
    table = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps({**table, str(number): entry}))


def write_bop(
    scene: Path,
    number: int = 1,
    objects: dict[int, np.ndarray] | list[tuple[int, np.ndarray]] = TWO,
    visible: list[float] | None = None,
    suffix: str = "png",
    seed: int = 0,
) -> Path:
    for kind in ("rgb", "depth", "mask_visib"):
        (scene / kind).mkdir(parents=True, exist_ok=True)
    color, depth, _ = images(seed)
    Image.fromarray(color).save(scene / "rgb" / f"{number:06d}.{suffix}")
    Image.fromarray(depth).save(scene / "depth" / f"{number:06d}.png")
    pairs = list(objects.items()) if isinstance(objects, dict) else objects
    for k, (_, mask) in enumerate(pairs):
        Image.fromarray(255 * mask.astype(np.uint8)).save(scene / "mask_visib" / f"{number:06d}_{k:06d}.png")
    update(scene / "scene_camera.json", number, {"cam_K": K, "depth_scale": 0.1, "cam_t_w2c": [0, 0, 1]})
    pose = {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 800]}
    update(scene / "scene_gt.json", number, [{**pose, "obj_id": obj_id} for obj_id, _ in pairs])
    if visible is not None:
        info = [{"visib_fract": v, "px_count_visib": 3, "bbox_visib": [0, 0, 1, 1]} for v in visible]
        update(scene / "scene_gt_info.json", number, info)
    return scene


CAMERA = Intrinsics(570.34, 565.21, 4.3, 2.6)
STEM = "result_2018-08-24-15-13-13"


def ocid_scene(seed: int = 0, first: int = 3, objects: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colour, depth and labels of the background, the table and bands of objects; some depth is missing."""
    rng = np.random.default_rng(seed)
    labels = np.ones(SHAPE, np.uint8)
    labels[:, 1:4] = first - 1
    for k in range(objects):
        labels[:, 4 + k] = first + k
    depth = rng.integers(500, 1500, SHAPE, dtype=np.uint16)
    depth[2] = labels[2] = 0
    return rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8), depth, labels


def points_of(depth: np.ndarray) -> np.ndarray:
    points = backproject(depth / 1000.0, CAMERA)
    points[depth == 0] = np.nan
    return points


def pack_pcd(points: np.ndarray, color: np.ndarray, labels: np.ndarray, data: str = "binary") -> bytes:
    """Return the bytes that PCL writes for points of type PointXYZRGBL, with labels one less than in the image."""
    height, width = labels.shape
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgba label\nSIZE 4 4 4 4 4\n"
        f"TYPE F F F U U\nCOUNT 1 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {width * height}\nDATA {data}\n"
    ).encode()
    rgba = 0xFF000000 + color.reshape(-1, 3) @ [1 << 16, 1 << 8, 1]
    columns = [*points.reshape(-1, 3).T, rgba, np.maximum(labels.ravel(), 1) - 1]
    rows = np.rec.fromarrays(columns, formats="<f4,<f4,<f4,<u4,<u4")
    in_text = "".join("{:.9g} {:.9g} {:.9g} {} {}\n".format(*row) for row in rows.tolist())
    return header + (in_text.encode() if data == "ascii" else rows.tobytes())


def write_ocid(root: Path, sequence: str = "table/bottom/curved/seq36", stem: str = STEM, **options: Any) -> Path:
    folder = root / sequence
    color, depth, labels = ocid_scene(first=2 if sequence.startswith("floor") else 3, **options)
    for kind, image in (("rgb", color), ("depth", depth), ("label", labels)):
        (folder / kind).mkdir(parents=True, exist_ok=True)
        picture = Image.fromarray(image)
        if kind == "label":
            picture.putpalette(np.arange(768, dtype=np.uint8) * 7)  # the dataset has indexed PNGs
        picture.save(folder / kind / f"{stem}.png")
    (folder / "pcd").mkdir(exist_ok=True)
    (folder / "pcd" / f"{stem}.pcd").write_bytes(pack_pcd(points_of(depth), color, labels))
    return folder


def vlg_item(answer: Any = 3, target: str = "mug", file: str = "seq36,b.png") -> dict[str, Any]:
    """Return an entry of a table of OCID-VLG."""
    return {"image_filename": file, "answer": answer, "target": target, "question": "Pick it."}


def write_uwis(root: Path, video: str, stem: str, poses: str, seed: int = 0) -> Path:
    folder = root / video / "images"
    folder.mkdir(parents=True, exist_ok=True)
    for kind, image in zip(("rgb", "depth", "labels"), images(seed, (720, 1280)), strict=True):
        Image.fromarray(image).save(folder / f"{stem}_{kind}.png")
    (folder / f"{stem}_poses.yaml").write_text(poses)
    return folder


def write_folder(folder: Path, labels: Any, seed: int = 0) -> Path:
    write_frame_files(folder, RGBDFrame(*images(seed), Intrinsics(600.0, 601.0, 4.0, 3.0)))
    (folder / "labels.json").write_text(json.dumps(labels))
    return folder


READERS: dict[str, Callable[[Path], LabelledFrames]] = {
    "bop": lambda root: BOP(root, root / "names.yaml"),
    "ocid": lambda root: OCID(root, root / "names.json"),
    "uwis": UWISOccluded,
    "folder": FrameFolder,
}
"""Kind of a dataset -> function that reads what `write_dataset` wrote."""


def write_dataset(kind: str, root: Path) -> None:
    """Write a dataset of two frames."""
    if kind == "bop":
        for scene in ("000048", "000049"):
            write_bop(root / scene, visible=[1.0, 1.0])
        (root / "names.yaml").write_text("8: mug\n14: bowl\n")
    elif kind == "ocid":
        write_ocid(root, "table/bottom/mixed/seq35", "a")
        write_ocid(root, "table/top/mixed/seq36", "b")
        names = ["mug", "bowl", "banana"]
        (root / "names.json").write_text(json.dumps({"seq35": names, "seq36": names}))
    elif kind == "uwis":
        for video in ("41", "42"):
            write_uwis(root, video, "000000", "mug:\n  label: 1\n  pose: [1, 0, 0]\nbowl:\n  label: 4\n")
    else:
        for name in "ab":
            write_folder(root / name, {"labels": {"1": "mug"}, "light": 1})
