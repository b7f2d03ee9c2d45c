"""OCID on small datasets with the layout of the real one, PCD files, and the fitted camera."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from commands import Command
from dataset_files import CAMERA, SHAPE, STEM, ocid_scene, pack_pcd, vlg_item, write_ocid
from PIL import Image
from refusals import assert_refused
from toy_recognizers import NamesInOrder

from thor2_jax.frames.frames import backproject
from training.evaluation import job
from training.evaluation.runs import Run as EvaluatedRun
from training.readers.ocid import OCID, fit_intrinsics, read_organized_points

ALL = {"seq36": ["mug", "bowl", "banana"]}


def write_names(root: Path, table: Any = ALL) -> Path:
    path = root / "names.yaml"
    path.write_text(yaml.safe_dump(table))
    return path


@pytest.mark.parametrize(("place", "first"), [("table", 3), ("floor", 2)])
def test_a_frame(tmp_path: Path, place: str, first: int) -> None:
    write_ocid(tmp_path, f"{place}/top/curved/seq36")
    (item,) = OCID(tmp_path, write_names(tmp_path))
    color, depth, labels = ocid_scene(first=first)
    assert item.identifier == f"{place}/top/curved/seq36/{STEM}"
    assert item.attributes == {"place": place, "camera": "upper", "type": "curved"}
    assert item.truth == {first: "mug", first + 1: "bowl", first + 2: "banana"}
    assert OCID(tmp_path, write_names(tmp_path)).names() == {"mug", "bowl", "banana"}
    np.testing.assert_array_equal(item.frame.color, color)
    np.testing.assert_array_equal(item.frame.depth, depth)
    np.testing.assert_array_equal(item.frame.labels, np.where(labels < first, 0, labels))
    fitted = item.frame.intrinsics
    numbers = fitted.fx, fitted.fy, fitted.cx, fitted.cy, fitted.depth_scale
    np.testing.assert_allclose(numbers, (570.34, 565.21, 4.3, 2.6, 1000), rtol=1e-4)


def test_only_objects_with_pixels_are_scored(tmp_path: Path) -> None:
    folder = write_ocid(tmp_path)
    labels = ocid_scene()[2]
    labels[labels == 4] = 5
    Image.fromarray(labels).save(folder / "label" / f"{STEM}.png")
    (item,) = OCID(tmp_path, write_names(tmp_path))
    assert item.truth == {3: "mug", 5: "banana"}
    without_third = OCID(tmp_path, write_names(tmp_path, {"seq36": ["mug", "bowl"]}))
    assert_refused(f"{folder / 'label' / STEM}.png.*label 5;", without_third.__getitem__, 0)
    cloud = folder / "pcd" / f"{STEM}.pcd"
    cloud.write_bytes(cloud.read_bytes().replace(b"WIDTH 9", b"WIDTH 54").replace(b"HEIGHT 6", b"HEIGHT 1"))
    assert_refused(rf"{cloud}.*\(1, 54\).*\(6, 9\)", without_third.__getitem__, 0)


def test_the_order_of_the_dataset_and_the_longest_end_of_a_path(tmp_path: Path) -> None:
    root = tmp_path / "YCB10"
    for sequence in ("table/top/mixed/seq21", "floor/top/cuboid/seq02", "table/bottom/mixed/seq21"):
        write_ocid(root, sequence, "result_b", seed=1)
        write_ocid(root, sequence, "result_a", seed=2)
    (root / "table" / "top" / "mixed" / "notes.txt").write_text("nothing to read")
    (root / "table" / "top" / "mixed" / "seq99").mkdir()
    table = {"seq21": list("abc"), "seq02": list("def"), "top/mixed/seq21": list("ghi"), "seq99": "not used", "7": None}
    names = write_names(tmp_path, table)
    whole = OCID(tmp_path, names)
    sequences = ("table/bottom/mixed/seq21", "table/top/mixed/seq21", "floor/top/cuboid/seq02")
    assert whole.identifiers == [f"{sequence}/result_{stem}" for sequence in sequences for stem in "ab"]
    assert [item.identifier for item in whole] == whole.identifiers == OCID(root, names).identifiers
    assert [item.attributes["camera"] for item in whole] == ["lower"] * 2 + ["upper"] * 4
    assert ["".join(item.truth.values()) for item in whole] == ["abc"] * 2 + ["ghi"] * 2 + ["def"] * 2


@pytest.mark.parametrize("sequence", ["YCB10/table/bottom/curved/seq36", "table/bottom/curved/seq36", "seq36"])
def test_names_of_vlg(tmp_path: Path, sequence: str) -> None:
    """Names hold for all images of a sequence; labels without a name are not scored; unlisted frames are left out."""
    for stem in (STEM, "later", "unlisted"):
        write_ocid(tmp_path, stem=stem)
    write_ocid(tmp_path, "floor/top/mixed/seq08")
    mug = vlg_item(3, "mug", f"{sequence},{STEM}.png")
    dataset = OCID(tmp_path, write_names(tmp_path, [mug, mug, vlg_item("5", "bowl_1", f"{sequence},later.png")]))
    assert dataset.identifiers == [f"table/bottom/curved/seq36/{stem}" for stem in ("later", STEM)]
    for item in dataset:
        assert item.frame.instances == (3, 4, 5)
        assert dict(item.truth) == {3: "mug", 5: "bowl_1"}


def test_the_camera_against_least_squares_of_numpy() -> None:
    rng = np.random.default_rng(1)
    points = backproject(rng.uniform(0.5, 1.5, (12, 17)), CAMERA) + rng.normal(0, 1e-4, (12, 17, 3))
    points[3:5, 2:9] = np.nan
    row, column = np.nonzero(np.isfinite(points[..., 0]))
    x, y, z = points[row, column].T
    fitted = fit_intrinsics(points)
    for pixel, ratio, focal, centre in ((column, x / z, fitted.fx, fitted.cx), (row, y / z, fitted.fy, fitted.cy)):
        slope, offset = np.linalg.lstsq(np.stack([pixel, np.ones(len(pixel))], axis=1), ratio, rcond=None)[0]
        np.testing.assert_allclose((focal, centre), (1 / slope, -offset / slope), rtol=1e-9)


def test_clouds_without_a_pinhole_camera() -> None:
    rng = np.random.default_rng(0)
    points = backproject(rng.uniform(0.5, 1.5, SHAPE), CAMERA)
    for changed, expected in (
        (-points, "the cloud has 0 points"),
        (np.where(np.arange(9)[:, None] == 3, points, np.nan), "the cloud has 6 points"),
        (points * [1, -1, 1], "fy -565.21"),
        (rng.permutation(points.reshape(-1, 3)).reshape(points.shape), "is not that"),
        (points * [0, 1, 1], "is not that"),
        (points * [1e300, 1e300, 1e-300], "is not that"),
    ):
        assert_refused(expected, fit_intrinsics, changed)


def test_runs_of_sequences(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command, refused: Command) -> None:
    """Each run has its own classes; one run serves both cameras."""
    sequences = ("table/bottom/curved/seq36", "table/top/curved/seq36", "table/top/mixed/seq08")
    for sequence in sequences:
        write_ocid(tmp_path / "YCB10", sequence)
    table = {"seq36": ["mug", "bowl", "bowl"], "table/top/mixed/seq08": ["banana", "apple", "mug"]}
    classes = {"seq36": ("mug", "bowl"), "seq08": ("banana", "apple")}
    runs = {name: [EvaluatedRun(name, name, NamesInOrder(each))] for name, each in classes.items()}
    monkeypatch.setattr("training.evaluation.runs.load_runs", lambda paths: runs[paths[0].name])
    models = tmp_path / "runs"
    names = write_names(tmp_path, table)
    command = ("evaluate", "ocid", tmp_path, "--model", models, "--names", names)
    for folder in ("table/top/mixed/seq08/fold-1", "seq36/fold-0"):
        (models / folder).mkdir(parents=True)
        (models / folder / "run.json").touch()
    output = printed(*command, "--per-sequence", "--out", tmp_path / "report")
    assert f"--model {models}/seq36/fold-0 " in output  # of the command that explains answers
    assert "Published table 1" in output and "Published table 3" not in output
    assert "Accuracy of the answers without rejection: " in output
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    cells = {tuple(table["by"]): table["cells"] for table in report["accuracy"]["max"]}
    assert {("camera",), ("camera", "place"), ("camera", "type")} < cells.keys()
    accuracy = {cell["where"]["sequence"]: cell["accuracy"]["TOPS"]["mean"] for cell in cells["sequence",]}
    assert accuracy == dict(zip(sequences, (1, 1, pytest.approx(2 / 3)), strict=True))
    assert "2 models are given" in refused(*command, "--per-sequence", tmp_path)
    monkeypatch.setattr(job, "load_runs", lambda *_: [EvaluatedRun("run", "0", NamesInOrder())])
    output = printed(*command)  # one run for all sequences
    assert "instances scored: " in output and "Published table 3" in output and "Published table 1" not in output
    names.unlink()
    assert refused(*command) == f"error: {names}: No such file or directory"


# Clouds in PCD files.


POINTS = np.array([(0.5 * k, -0.25 * k, np.nan if k == 4 else 1.0 + k) for k in range(6)]).reshape(2, 3, 3)


def write_cloud(path: Path, data: str, old: bytes = b"", new: bytes = b"") -> Path:
    """Write six points, whose labels are 0 to 5, with bytes replaced that occur once."""
    content = pack_pcd(POINTS, np.zeros((2, 3, 3), int), np.arange(1, 7).reshape(2, 3), data)
    content = content.replace(struct.pack("<f", np.nan), b"\x01\0\x80\x7f")  # a signalling one
    assert not old or content.count(old) == 1
    path.write_bytes(content.replace(old, new) if old else content)
    return path


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_points(tmp_path: Path, data: str) -> None:
    for count in (b"COUNT 1 1 1 1 1\n", b""):
        points = read_organized_points(write_cloud(tmp_path / "cloud.pcd", data, b"COUNT 1 1 1 1 1\n", count))
        np.testing.assert_array_equal(points, POINTS, strict=True)


def test_points_among_other_fields(tmp_path: Path) -> None:
    """The file has a field of three numbers, padding, other number types, another order of axes and CR LF line ends."""
    path = tmp_path / "cloud.pcd"
    header = (
        "VERSION .7\r\nFIELDS _ z normal x _ y\r\nSIZE 1 8 4 4 2 4\r\nTYPE U F F F I F\r\nCOUNT 3 1 3 1 1 1\r\n"
        "WIDTH 2\r\nHEIGHT 1\r\nPOINTS 2\r\nDATA {}\r\n"
    )
    rows = [(0, 1, 2, 3.5, 9.0, 9.0, 9.0, 1.5, -7, 2.5), (0, 1, 2, float("nan"), 9.0, 9.0, 9.0, 4.0, -7, 5.0)]
    path.write_bytes(header.format("binary").encode() + b"".join(struct.pack("<3Bd3ffhf", *row) for row in rows))
    expected = [[[1.5, 2.5, 3.5], [4.0, 5.0, np.nan]]]
    np.testing.assert_array_equal(read_organized_points(path), expected)
    text = "\r\n".join(" ".join(map(str, row)) for row in rows)
    path.write_bytes((header.format("ascii") + text).encode())
    np.testing.assert_array_equal(read_organized_points(path), expected)


DAMAGED_HEADERS = (
    (b"DATA", b"DATE"),
    (b"FIELDS x y z", b"FIELDS x y w"),
    (b"SIZE 4", b"SIZE 3"),
    (b"TYPE F F F U U\n", b""),
    (b"COUNT 1", b"COUNT 2"),
    (b"COUNT 1 1 1 1 1", b"COUNT 1 1 1 1 9999999999999999999999"),
    (b"WIDTH 3", b"WIDTH 0"),
    (b"WIDTH 3", b"WIDTH"),
    (b"HEIGHT 2", b"HEIGHT 3"),
)


def test_damaged_clouds(tmp_path: Path) -> None:
    for data, old, new, expected in (
        ("binary", b"DATA binary", b"DATA binary_compressed", "DATA binary_compressed"),
        ("binary", b"\x05\0\0\0", b"\x05\0\0", "or is cut off"),
        ("ascii", b" 5\n", b"\n", "6 points of 5 numbers"),
        ("ascii", b"2.5 ", b"x ", "6 points of 5 numbers"),
        *((data, *each, "") for data in ("ascii", "binary") for each in DAMAGED_HEADERS),
    ):
        path = write_cloud(tmp_path / "cloud.pcd", data, old, new)
        assert_refused(f"{path}.*{expected}", read_organized_points, path)
