"""OCID on small datasets with the layout of the real one; the fitted camera against the one that made the clouds."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dataset_files import CAMERA, SHAPE, STEM, ocid_scene, points_of, write_ocid
from helpers import Command, NamesInOrder, input_error
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics, backproject
from training.evaluation.answering import answer_frames
from training.evaluation.results import compute_results
from training.evaluation.runs import Run as EvaluatedRun
from training.readers import OCID, FrameFolder
from training.readers.ocid import fit_intrinsics, read_organized_points

ALL = {"seq36": ["mug", "bowl", "banana"]}


def write_names(root: Path, table: Any = ALL, name: str = "names.yaml") -> Path:
    path = root / name
    path.write_text(json.dumps(table) if name.endswith(".json") else yaml.safe_dump(table))
    return path


def error_message(root: Path, names: Path) -> str:
    with pytest.raises(InputError) as caught:
        list(OCID(root, names))
    return str(caught.value)


# Frames


@pytest.mark.parametrize("data", ["binary", "ascii"])
@pytest.mark.parametrize(("place", "first"), [("table", 3), ("floor", 2)])
def test_a_frame(tmp_path: Path, place: str, first: int, data: str) -> None:
    folder = write_ocid(tmp_path, f"{place}/top/curved/seq36", data=data)
    with Image.open(folder / "label" / f"{STEM}.png") as image:
        assert image.mode == "P"
    (item,) = OCID(tmp_path, write_names(tmp_path))
    color, depth, labels = ocid_scene(first=first)
    assert item.identifier == f"{place}/top/curved/seq36/{STEM}"
    assert item.attributes == {"place": place, "camera": "upper", "type": "curved"}
    assert item.truth == {first: "mug", first + 1: "bowl", first + 2: "banana"}
    np.testing.assert_array_equal(item.frame.color, color)
    np.testing.assert_array_equal(item.frame.depth, depth)
    assert item.frame.instances == (first, first + 1, first + 2)
    np.testing.assert_array_equal(item.frame.labels, np.where(labels < first, 0, labels))
    fitted = item.frame.intrinsics
    np.testing.assert_allclose(
        (fitted.fx, fitted.fy, fitted.cx, fitted.cy, fitted.depth_scale), (570.34, 565.21, 4.3, 2.6, 1000), rtol=1e-4
    )
    # The points of the frame equal those of the cloud.
    there = depth > 0
    np.testing.assert_allclose(
        backproject(item.frame.depth_m, fitted)[there], points_of(depth)[there], rtol=1e-4, atol=1e-6
    )


def test_16_bit_labels(tmp_path: Path) -> None:
    folder = write_ocid(tmp_path)
    Image.fromarray(ocid_scene()[2].astype(np.uint16)).save(folder / "label" / f"{STEM}.png")
    (item,) = OCID(tmp_path, write_names(tmp_path))
    assert item.truth == {3: "mug", 4: "bowl", 5: "banana"}


def test_objects_are_added_along_a_sequence(tmp_path: Path) -> None:
    """Only objects with pixels are scored."""
    for k in range(4):
        write_ocid(tmp_path, stem=f"result_{k}", objects=k)
    items = list(OCID(tmp_path, write_names(tmp_path)))
    assert [item.identifier[-1] for item in items] == ["0", "1", "2", "3"]
    assert [len(item.truth) for item in items] == [0, 1, 2, 3]
    assert items[2].truth == {3: "mug", 4: "bowl"}


def test_objects_that_are_temporarily_occluded(tmp_path: Path) -> None:
    folder = write_ocid(tmp_path)
    labels = ocid_scene()[2]
    labels[labels == 4] = 5
    Image.fromarray(labels).save(folder / "label" / f"{STEM}.png")
    (item,) = OCID(tmp_path, write_names(tmp_path))
    assert item.truth == {3: "mug", 5: "banana"}


def test_the_order_of_the_dataset(tmp_path: Path) -> None:
    root = tmp_path / "YCB10"
    for sequence in ("table/top/mixed/seq21", "floor/top/cuboid/seq02", "table/bottom/mixed/seq21"):
        write_ocid(root, sequence, "result_b", seed=1)
        write_ocid(root, sequence, "result_a", seed=2)
    (root / "table" / "top" / "mixed" / "notes.txt").write_text("nothing to read")
    (root / "table" / "top" / "mixed" / "seq99").mkdir()
    names = write_names(tmp_path, {"seq21": ["a", "b", "c"], "seq02": ["d", "e", "f"]})
    whole, subset = OCID(tmp_path, names), OCID(root, names)
    assert len(whole) == len(subset) == 6
    identifiers = [item.identifier for item in whole]
    assert identifiers == [
        f"{sequence}/result_{stem}"
        for sequence in ("table/bottom/mixed/seq21", "table/top/mixed/seq21", "floor/top/cuboid/seq02")
        for stem in "ab"
    ]
    assert identifiers == [item.identifier for item in subset] == [item.identifier for item in whole]
    assert [item.attributes["camera"] for item in whole] == ["lower"] * 2 + ["upper"] * 4


# Names


@pytest.mark.parametrize("name", ["names.yaml", "names.json"])
def test_names_of_the_longest_matching_path_suffix_are_used(tmp_path: Path, name: str) -> None:
    for camera in ("bottom", "top"):
        write_ocid(tmp_path, f"table/{camera}/curved/seq36")
    table = {"seq36": ["a", "b", "c"], "top/curved/seq36": ["d", "e", "f"], "seq99": "not used", "7": None}
    lower, upper = OCID(tmp_path, write_names(tmp_path, table, name))
    assert list(lower.truth.values()) == ["a", "b", "c"] and list(upper.truth.values()) == ["d", "e", "f"]


def test_sequences_without_names(tmp_path: Path) -> None:
    for sequence in ("table/bottom/curved/seq36", "table/top/curved/seq36", "floor/top/mixed/seq08"):
        write_ocid(tmp_path, sequence)
    names = write_names(tmp_path, {"table/top/curved/seq36": ["a", "b", "c"]})
    with pytest.raises(InputError, match=r"names\.yaml .*table/bottom/curved/seq36, floor/top/mixed"):
        OCID(tmp_path, names)


@pytest.mark.parametrize("value", [None, "mug", {"mug": 3}, ["mug", None], ["mug", 7], [""], [["mug"]]])
def test_invalid_names(tmp_path: Path, value: Any) -> None:
    write_ocid(tmp_path)
    message = error_message(tmp_path, write_names(tmp_path, {"seq36": value}))
    assert f"names.yaml: seq36 is {value!r};" in message


@pytest.mark.parametrize(
    "text",
    ["[mug]", "", "seq36: [mug", "a: !!timestamp x", "!!python/object/apply:os.getcwd []", "a: !!int ''", "\x00"],
)
def test_damaged_tables(tmp_path: Path, text: str) -> None:
    write_ocid(tmp_path)
    names = tmp_path / "names.yaml"
    names.write_text(text)
    assert error_message(tmp_path, names).startswith(str(names))


def test_labels_without_a_name(tmp_path: Path) -> None:
    folder = write_ocid(tmp_path)
    message = error_message(tmp_path, write_names(tmp_path, {"seq36": ["mug", "bowl"]}))
    assert str(folder / "label" / f"{STEM}.png") in message and "label 5;" in message


# Names of OCID-VLG


def vlg_item(label: int | str, name: str, sequence: str, stem: str = STEM) -> dict[str, Any]:
    return {"image_filename": f"{sequence},{stem}.png", "answer": label, "target": name, "question": "Pick it."}


@pytest.mark.parametrize("sequence", ["YCB10/table/bottom/curved/seq36", "table/bottom/curved/seq36", "seq36"])
def test_names_of_vlg(tmp_path: Path, sequence: str) -> None:
    """Names hold for all images of a sequence; labels without a name are not scored; unlisted frames are left out."""
    write_ocid(tmp_path)
    write_ocid(tmp_path, stem="later")
    write_ocid(tmp_path, stem="unlisted")
    write_ocid(tmp_path, "floor/top/mixed/seq08")
    items = [vlg_item(3, "mug", sequence), vlg_item(3, "mug", sequence), vlg_item("5", "bowl_1", sequence, "later")]
    names = tmp_path / "test.json"
    names.write_text(json.dumps(items))
    dataset = OCID(tmp_path, names)
    assert dataset.identifiers == [f"table/bottom/curved/seq36/{stem}" for stem in ("later", STEM)]
    for item in dataset:
        assert item.frame.instances == (3, 4, 5)
        assert dict(item.truth) == {3: "mug", 5: "bowl_1"}


@pytest.mark.parametrize(
    ("items", "expected"),
    [
        ([], "lists no frame"),
        ([vlg_item(3, "mug", "seq99")], "lists no frame"),
        ([{"image_filename": "seq36,a.png", "answer": 3}], "item 0 is"),
        ([vlg_item(3, "mug", "seq36"), vlg_item(3, "", "seq36")], "item 1 is"),
        ([{**vlg_item(3, "mug", "seq36"), "answer": "mug"}], "item 0 is"),
        ([{**vlg_item(3, "mug", "seq36"), "answer": True}], "item 0 is"),
        ([{**vlg_item(3, "mug", "seq36"), "image_filename": "seq36"}], "item 0 is"),
        ([7], "item 0 is 7"),
        ([vlg_item(3, "mug", "seq36"), vlg_item(3, "bowl", "seq36")], "the names 'mug' and 'bowl'"),
    ],
)
def test_invalid_names_of_vlg(tmp_path: Path, items: Any, expected: str) -> None:
    write_ocid(tmp_path)
    names = tmp_path / "names.json"
    names.write_text(json.dumps(items))
    with input_error(expected, names):
        OCID(tmp_path, names)


# Files


@pytest.mark.parametrize("file", ["depth/{}.png", "label/{}.png", "pcd/{}.pcd"])
def test_files_that_are_missing(tmp_path: Path, file: str) -> None:
    path = write_ocid(tmp_path) / file.format(STEM)
    path.unlink()
    assert error_message(tmp_path, write_names(tmp_path)) == f"table/bottom/curved/seq36/{STEM}: {path} is missing"


@pytest.mark.parametrize(
    ("file", "kept"),
    [(f"{kind}/{STEM}.png", kept) for kind in ("rgb", "depth", "label") for kept in (0, 60)]
    + [(f"pcd/{STEM}.pcd", kept) for kept in (0, 60, -3)],
)
def test_files_that_are_cut_off(tmp_path: Path, file: str, kept: int) -> None:
    path = write_ocid(tmp_path) / file
    path.write_bytes(path.read_bytes()[:kept])
    assert str(path) in error_message(tmp_path, write_names(tmp_path))


def test_signalling_nan(tmp_path: Path) -> None:
    header = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(header.encode() + struct.pack("<3I", *[0x7F800001] * 3))
    assert np.isnan(read_organized_points(tmp_path / "a.pcd")).all()


def test_frames_are_read_one_at_a_time(tmp_path: Path) -> None:
    write_ocid(tmp_path, stem="result_a")
    (write_ocid(tmp_path, stem="result_b") / "pcd" / "result_b.pcd").write_bytes(b"damaged")
    frames = iter(OCID(tmp_path, write_names(tmp_path)))
    assert next(frames).identifier.endswith("result_a")
    with pytest.raises(InputError, match="result_b"):
        next(frames)


def test_images_of_different_sizes(tmp_path: Path) -> None:
    folder = write_ocid(tmp_path)
    Image.fromarray(np.zeros((5, 9), np.uint16)).save(folder / "depth" / f"{STEM}.png")
    assert "depth has shape (5, 9)" in error_message(tmp_path, write_names(tmp_path))
    cloud = folder / "pcd" / f"{STEM}.pcd"
    cloud.write_bytes(cloud.read_bytes().replace(b"WIDTH 9", b"WIDTH 54").replace(b"HEIGHT 6", b"HEIGHT 1"))
    message = error_message(tmp_path, write_names(tmp_path))
    assert str(cloud) in message and "(1, 54)" in message and "(6, 9)" in message


def test_paths_that_are_not_a_dataset(tmp_path: Path) -> None:
    names = write_names(tmp_path)
    for path, expected in (
        (tmp_path / "absent", "is not a directory"),
        (names, "is not a directory"),
        (tmp_path, "has no {table,floor}"),
    ):
        with input_error(f"{path} {expected}", match=r"^dataset: "):
            OCID(path, names)


# The camera


def test_the_camera_behind_averaged_depth() -> None:
    """Points as the dataset's tool computes them: x and y from one frame, z the mean of ten frames in whole mm.

    The noise is that of a structured-light sensor, 1.5 mm at 1 m, proportional to the square of the depth.
    """
    camera = Intrinsics(570.3422, 571.9, 314.5, 235.5)
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:480, :640]
    surface = 0.7 + 0.002 * row + 0.0005 * column
    noisy = (surface + rng.normal(0, 0.0015, (10, 480, 640)) * surface**2).round(3)
    points = backproject(noisy[0], camera)
    points[..., 2] = noisy.mean(axis=0)
    points[rng.random((480, 640)) < 0.2] = np.nan
    fitted = fit_intrinsics(points)
    np.testing.assert_allclose((fitted.fx, fitted.fy), (camera.fx, camera.fy), rtol=1e-4)
    np.testing.assert_allclose((fitted.cx, fitted.cy), (camera.cx, camera.cy), atol=0.02)


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


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda p: np.full_like(p, np.nan), "the cloud has 0 points"),
        (lambda p: -p, "the cloud has 0 points"),
        (lambda p: np.where(np.arange(9)[:, None] == 3, p, np.nan), "the cloud has 6 points"),
        (lambda p: p * [1, -1, 1], "fy -565.21"),
        (lambda p: p[:, ::-1], "is not that"),
        (lambda p: np.random.default_rng(0).permutation(p.reshape(-1, 3)).reshape(p.shape), "is not that"),
        (lambda p: p * [0, 1, 1], "is not that"),
        (lambda p: p * [1e300, 1e300, 1e-300], "is not that"),
        (lambda p: p * 0 + 1, "is not that"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_clouds_without_a_pinhole_camera(change: Any, expected: str) -> None:
    depth = np.random.default_rng(0).uniform(0.5, 1.5, SHAPE)
    with input_error(expected):
        fit_intrinsics(change(backproject(depth, CAMERA)))


def test_the_camera_of_real_depth(shared: Path) -> None:
    """The camera is recovered from the cloud of a real frame in the precision of OCID."""
    folder = shared / "data" / "frames" / "ycbv_real_0000"
    if not folder.is_dir():
        pytest.skip("no real frames beside the checkout")
    frame = next(iter(FrameFolder(folder))).frame
    points = backproject(frame.depth_m.astype(np.float64), frame.intrinsics)
    points[frame.depth == 0] = np.nan
    fitted = fit_intrinsics(points.astype(np.float32).astype(np.float64))
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(fitted, name) == pytest.approx(getattr(frame.intrinsics, name), abs=1e-3)


# Evaluation


def test_accuracy_by_condition(tmp_path: Path) -> None:
    write_ocid(tmp_path, "table/bottom/curved/seq36", objects=2)
    write_ocid(tmp_path, "floor/top/mixed/seq08")
    names = write_names(tmp_path, {"seq36": ["mug", "bowl"], "seq08": ["bowl", "bowl", "banana"]})
    run = EvaluatedRun("run", "", NamesInOrder())  # type: ignore[arg-type]
    answers = [answers for _, answers in answer_frames([run], OCID(tmp_path, names))]
    instances = [(i.label, i.truth) for frame in answers for i in frame.instances]
    assert instances == [(3, "mug"), (4, "bowl"), (2, "bowl"), (3, "bowl"), (4, "banana")]
    tables = compute_results("frames", [run], answers)["accuracy"]["max"]
    accuracy = {
        (*table["by"], *cell["where"].values()): (cell["instances"], cell["accuracy"]["TOPS"]["mean"])
        for table in tables
        for cell in table["cells"]
    }
    assert accuracy[()] == (4, 0.75)
    assert accuracy["place", "floor"] == (2, 0.5) and accuracy["place", "table"] == (2, 1.0)
    assert accuracy["camera", "lower"] == (2, 1.0) and accuracy["camera", "upper"] == (2, 0.5)
    assert accuracy["type", "curved"] == (2, 1.0) and accuracy["type", "mixed"] == (2, 0.5)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command, refused: Command) -> None:
    write_ocid(tmp_path / "YCB10")
    names = write_names(tmp_path)
    runs = [EvaluatedRun("run", "0", NamesInOrder())]
    monkeypatch.setattr("training.evaluation.answering.load_runs", lambda paths: runs)
    options = ("--model", tmp_path / "run", "--names", names)
    output = printed("evaluate", "ocid", tmp_path, *options, "--out", tmp_path / "report")
    assert "2 instances scored" in output
    assert "Published table 3" in output and "Published table 1" not in output
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["instances"]["scored"] == 2 and sum(report["instances"]["no_class"].values()) == 1
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Models: run." in page and "banana (unknown object)" in page
    cell = report["accuracy"]["max"][0]["cells"][0]
    assert cell["instances"] == 2 and cell["accuracy"]["TOPS"]["mean"] == 1.0
    names.unlink()
    assert refused("evaluate", "ocid", tmp_path, *options) == f"error: {names}: No such file or directory"


def test_each_sequence_has_its_own_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Command, refused: Command
) -> None:
    """Each run has its own classes; one run serves both cameras."""
    sequences = {"seq36": ["mug", "bowl", "bowl"], "table/top/mixed/seq08": ["banana", "apple", "mug"]}
    for place in ("table/bottom/curved/seq36", "table/top/curved/seq36", "table/top/mixed/seq08"):
        write_ocid(tmp_path / "YCB10", place)
    names = write_names(tmp_path, sequences)
    classes = {"seq36": ("mug", "bowl"), "seq08": ("banana", "apple")}

    def load(paths: Sequence[Path]) -> list[EvaluatedRun]:
        (path,) = paths
        return [EvaluatedRun(path.name, f"digest of {path.name}", NamesInOrder(classes[path.name]))]  # type: ignore[arg-type]

    monkeypatch.setattr("training.evaluation.runs.load_runs", load)
    models = tmp_path / "runs"
    (models / "seq36").mkdir(parents=True)
    options = ("--model", models, "--names", names, "--per-sequence")
    error = refused("evaluate", "ocid", tmp_path, *options)
    assert f"error: model: {models} has no run for table/top/mixed/seq08; " in error
    (models / "table/top/mixed/seq08").mkdir(parents=True)
    output = printed("evaluate", "ocid", tmp_path, *options, "--out", tmp_path / "report")
    assert [number for number in range(1, 10) if f"Published table {number}:" in output] == [1, 2, 8]
    assert "63.33 ±\u00a00.98" in output  # THOR2 in S-36, lower camera
    report = json.loads((tmp_path / "report" / "report.json").read_text())
    assert report["runs"] == ["runs/*"] and report["classes"] == ["apple", "banana", "bowl", "mug"]
    by = {tuple(table["by"]): table["cells"] for table in report["accuracy"]["max"]}
    shares = {cell["where"]["sequence"]: cell["accuracy"]["TOPS"]["mean"] for cell in by["sequence",]}
    assert [round(share, 3) for share in shares.values()] == [1.0, 1.0, 0.667]
    assert "2 models are given" in refused("evaluate", "ocid", tmp_path, *options, tmp_path)
