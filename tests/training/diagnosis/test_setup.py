"""Diagnosis of set-ups: silence on sound frames, and the right finding on damaged ones (the page's sample frames)."""

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, Texts, json_lines
from dataset_files import write_bop
from image_files import SAMPLES
from rendered_objects import write_box
from toy_recognizers import recognizer_that_prefers

from benchmarks.doctor import _interpolated, _zoomed
from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject, encode_image
from training.diagnosis.checks import Diagnosis, check_camera, check_labels, check_meshes
from training.diagnosis.colors import check_channel_order, check_light
from training.diagnosis.depth import check_depth, instance_extents
from training.diagnosis.registration import check_labels_alignment, check_registration
from training.diagnosis.setup import diagnose
from training.readers.frames import FrameFiles, frame_files


@pytest.fixture(scope="module")
def frame() -> RGBDFrame:
    return frame_files(SAMPLES / "breakfast").read()


def assert_found(expected: str, check: Callable[..., Any], *arguments: Any, **options: Any) -> Diagnosis:
    """Assert that the only finding of a check begins with a pattern, as the command prints it; "" expects none."""
    diagnosis = Diagnosis()
    check(diagnosis, *arguments, **options)
    finding = " ".join(f"{each.code}: {each.message} {each.advice}" for each in diagnosis.findings)
    assert re.match(expected or "$", finding), finding
    assert len(diagnosis.findings) <= 1
    assert all(each.message.endswith(".") and each.advice.endswith(".") for each in diagnosis.findings)
    return diagnosis


@pytest.mark.parametrize("name", ["breakfast", "clutter", "crockery", "tools"])
def test_sound_frames_have_no_findings(name: str) -> None:
    files = frame_files(SAMPLES / name)
    diagnosis = diagnose(files)
    assert diagnosis.findings == [] and any("--model" in note for note in diagnosis.notes)
    assert diagnose(dataclasses.replace(files, labels=None)).findings == []


def test_intrinsics() -> None:
    for changes, expected in (
        ({"cx": 330, "cy": 225}, ""),
        ({"width": 640, "height": 480}, ""),
        ({"width": 1280, "height": 720}, "intrinsics-size"),
        ({"cx": 640, "cy": 480}, "intrinsics-size"),
        ({"cx": 160, "cy": 120}, "intrinsics-size"),
        ({"cx": 240, "cy": 320}, "intrinsics-size: .*exchanged"),
        ({"fx": 900}, "intrinsics-aspect"),
        ({"fx": 3.6, "fy": 3.6}, "intrinsics-focal"),
        ({"fx": 6000, "fy": 6000}, "intrinsics-focal: .* 6.1 degrees"),
    ):
        camera = Intrinsics(**{"fx": 570, "fy": 575, "cx": 319.5, "cy": 239.5, **changes})
        assert_found(expected, check_camera, camera, 640, 480)


change = dataclasses.replace


def with_scale(frame: RGBDFrame, scale: float) -> RGBDFrame:
    return change(frame, intrinsics=change(frame.intrinsics, depth_scale=scale))


def with_focal_factor(frame: RGBDFrame, factor: float) -> RGBDFrame:
    k = frame.intrinsics
    return change(frame, intrinsics=change(k, fx=k.fx * factor, fy=k.fy * factor))


def with_one_mask_of_two_thirds(frame: RGBDFrame) -> RGBDFrame:
    labels = np.zeros(frame.depth.shape, np.uint8)
    labels[: labels.shape[0] * 2 // 3] = 255
    return change(frame, labels=labels, depth=np.full(frame.depth.shape, 1000, np.uint16))


DEPTH: dict[str, tuple[Callable[[RGBDFrame], RGBDFrame], str]] = {
    "0.1 mm": (lambda f: with_scale(change(f, depth=(f.depth * 10).astype(np.uint16)), 1000), "depth-unit: .*10000"),
    "mm as units of 0.2 mm": (lambda f: with_scale(f, 5000), "distance: .*depth_scale is wrong"),
    "metres per unit": (lambda f: with_scale(f, 0.001), "depth-unit: .*1000"),
    "floats in mm": (lambda f: change(f, depth=f.depth.astype(np.float32)), "depth-unit: .*Divide it by 1000"),
    "floats in metres": (lambda f: change(f, depth=f.depth_m), ""),
    "no labels, metres per unit": (lambda f: change(with_scale(f, 0.001), labels=None), "depth-unit: .*1000"),
    "no depth": (lambda f: change(f, depth=f.depth * 0), "depth-missing"),
    "one depth": (lambda f: change(f, depth=(f.depth > 0) * np.uint16(900)), "depth-constant: .* 0.9 m"),
    "little depth": (lambda f: change(f, depth=f.depth * (np.indices(f.depth.shape)[1] % 10 == 0)), "depth-missing"),
    "far": (lambda f: with_focal_factor(change(f, depth=f.depth * np.uint16(5)), 5), "distance: .*0.5 to 1.5 m"),
    "a mask of touching objects": (with_one_mask_of_two_thirds, "labels-foreground"),
}


@pytest.mark.parametrize("name", DEPTH)
def test_depth(frame: RGBDFrame, name: str) -> None:
    damage, expected = DEPTH[name]
    assert_found(expected, check_depth, damage(frame))


def test_extents_of_a_tilted_plate() -> None:
    """A rectangle of 0.3 x 0.1 m that is turned by 40 degrees; percentiles cut 4 % off. Its mask shows a wall, too."""
    camera = Intrinsics(500, 500, 160, 120)
    points = backproject(np.full((240, 320), 0.8, np.float32), camera)
    angle = np.radians(40)
    along = points[..., 0] * np.cos(angle) + points[..., 1] * np.sin(angle)
    across = points[..., 1] * np.cos(angle) - points[..., 0] * np.sin(angle)
    labels = ((np.abs(along) < 0.2) & (np.abs(across) < 0.05)).astype(np.uint8)
    depth = np.where(np.abs(along) < 0.15, points[..., 2], np.float32(2))
    plate = RGBDFrame(np.zeros((240, 320, 3), np.uint8), depth, labels, camera)
    assert instance_extents(plate) == {1: pytest.approx(0.3 * 0.96, rel=0.02)}


def test_objects_are_compared_with_the_meshes(frame: RGBDFrame) -> None:
    sides = {str(label): extent for label, extent in instance_extents(frame).items()}
    side = float(np.median(list(sides.values())))
    halved, longer = with_focal_factor(frame, 0.5), {name: 1.1 * side for name, side in sides.items()}
    for meshes in (sides, {"median": side, "small": side / 3}):
        assert_found("", check_depth, frame, meshes)
        assert_found("intrinsics-focal", check_depth, halved, meshes)
    names = {label: str(label) for label in frame.instances}
    assert_found("intrinsics-focal", check_depth, with_focal_factor(frame, 0.6), longer | {"large": 0.6}, names)
    assert_found("depth-unit", check_depth, frame, {name: side / 10 for name, side in sides.items()})
    near = with_scale(frame, 6 * frame.intrinsics.depth_scale)
    assert_found("depth-unit", check_depth, near, sides | {"pin": side / 10}, names)
    longest = max(sides, key=lambda name: sides[name])  # is not compared with the objects without a mesh
    assert_found("", check_depth, frame, {longest: sides[longest], "other": side}, names)
    assert assert_found("", check_depth, frame, {"other": side / 3}, names).notes
    assert_found("", check_depth, frame, {"pin": 0.01}, trust_camera=False)


BLOB = np.pad(np.ones((30, 20), np.uint8), ((10, 50), (5, 5)))


def test_labels(frame: RGBDFrame) -> None:
    for make, expected in (
        (lambda labels: labels.astype(np.int32) * 1000, ""),
        (lambda labels: labels * 0, "labels-empty"),
        (lambda labels: labels + 1, "labels-background"),
        (_interpolated, "labels-(thin|many)"),
        (lambda labels: np.tile(np.arange(120) % 4 // 2 * (np.arange(120) // 4 + 1), (90, 1)), "labels-thin"),
        (lambda labels: np.random.default_rng(0).integers(0, 256, labels.shape).astype(np.uint8), "labels-many"),
        (lambda labels: np.tile(BLOB, 2), ""),
        (lambda labels: np.tile(BLOB, 3) * 255, "labels-foreground"),
    ):
        assert_found(expected, check_labels, make(frame.label_image))


def test_registration_of_depth_and_of_labels(frame: RGBDFrame) -> None:
    for damage, expected in (
        (lambda depth: np.roll(depth, (0, 3), (0, 1)), ""),
        (lambda depth: np.roll(depth, (0, 20), (0, 1)), "registration: .*moved (19|20|21) pixels left"),
        (lambda depth: np.roll(depth, (-16, 0), (0, 1)), "registration: .*moved (15|16|17) pixels down"),
        (lambda depth: np.ascontiguousarray(depth[:, ::-1]), "registration: .*mirrored"),
        (_zoomed(1.15), "registration: .*enlarged by a factor of 1.1"),
        (np.ones_like, ""),
        (np.zeros_like, ""),
    ):
        assert_found(expected, check_registration, frame.color, damage(frame.depth_m))
    flat = np.zeros((90, 120, 3), np.uint8), np.ones((90, 120))
    assert "registration" in assert_found("", check_registration, *flat).notes[0]
    moved = np.roll(frame.label_image, 25, axis=1)
    assert_found("labels-shifted: .*moved (24|25|26) pixels left", check_labels_alignment, frame.color, moved)


def test_light(frame: RGBDFrame) -> None:
    for damage, expected in (
        (lambda color: color // 8, "color-dark"),
        (lambda color: np.minimum(color.astype(int) * 8, 255).astype(np.uint8), "color-bright"),
        (lambda color: np.repeat(color[..., :1], 3, axis=2), "color-gray"),
        (lambda color: (color * [1.0, 0.7, 0.25]).astype(np.uint8), "color-cast"),
    ):
        assert_found(expected, check_light, damage(frame.color), frame.labels)


def test_exchanged_channels_are_found_by_a_model(frame: RGBDFrame) -> None:
    """Colours of the sample are multiplied so that red and blue differ."""
    color = (frame.color * [1.0, 0.8, 0.4]).astype(np.uint8)
    right, wrong = change(frame, color=color), change(frame, color=np.ascontiguousarray(color[..., ::-1]))
    recognizer = recognizer_that_prefers(color)
    assert_found("", check_channel_order, right, recognizer)
    assert_found("bgr", check_channel_order, wrong, recognizer)
    assert_found("color-light: .*twice as bright", check_channel_order, change(frame, color=color // 2), recognizer)
    for few in (recognizer_that_prefers(color, n=1), recognizer_that_prefers(color, ())):
        assert "not checked" in assert_found("", check_channel_order, wrong, few).notes[0]
    files = frame_files(SAMPLES / "breakfast")
    for given, scale, reason in ((change(files, labels=None), None, "no labels"), (files, 100, "other findings")):
        assert reason in diagnose(given, depth_scale=scale, recognizer=recognizer).notes[-1]


def test_units_of_meshes(tmp_path: Path) -> None:
    for side, scale, expected in (
        (0.2, 1.0, ""),
        (200.0, 1.0, "mesh-unit: .*--mesh-scale 0.001"),
        (200.0, 0.001, ""),
        (20.0, 1.0, "mesh-unit: .*--mesh-scale 0.01"),
        (0.0002, 1.0, "mesh-unit: .*--mesh-scale 1000"),
        (1e9, 1.0, "mesh-unit: .*--mesh-scale"),
        (0.2, np.nan, "mesh: .*mesh_scale is nan"),
    ):
        meshes = {"box": write_box(tmp_path / "box.ply", (side, side / 2, side / 3))}
        assert_found(expected, check_meshes, meshes, scale)
        assert check_meshes(Diagnosis(), meshes, scale) == ({} if expected else {"box": pytest.approx(0.2)})
        meshes["box"].write_text("no mesh")
        assert_found("mesh: ", check_meshes, meshes, scale)


def copy_of(folder: Path, **contents: bytes) -> FrameFiles:
    """Copy a sample; `contents` replaces files by name."""
    files = frame_files(Path(shutil.copytree(SAMPLES / "crockery", folder, dirs_exist_ok=True)))
    for name, content in contents.items():
        getattr(files, name).write_bytes(content)
    return files


def test_files_of_the_wrong_kind_are_findings(tmp_path: Path) -> None:
    original = frame_files(SAMPLES / "crockery").read()
    photo = encode_image(original.color)

    def codes(**contents: bytes) -> set[str]:
        return {finding.code for finding in diagnose(copy_of(tmp_path, **contents)).findings}

    assert codes(labels=photo, intrinsics=b"{}") == {"unreadable-labels", "unreadable-intrinsics"}
    assert codes(color=b"", depth=photo) == {"unreadable-color", "unreadable-depth"}
    assert codes(labels=encode_image(original.labels * 0)) == {"labels-empty"}
    assert "size" in codes(depth=encode_image(np.ascontiguousarray(original.depth[::2, ::2])))
    fields = dataclasses.asdict(original.intrinsics)
    for distortion, expected in ((-9.0, {"unreadable-intrinsics"}), (0.1, set())):
        camera = json.dumps({**fields, "distortion": [distortion, 0, 0, 0]}).encode()
        assert codes(intrinsics=camera) == expected


def test_the_command(tmp_path: Path, texts: Texts, printed: Command, refused: Command) -> None:
    files = copy_of(tmp_path)
    command = ("doctor", *(part for name, path in vars(files).items() for part in (f"--{name}", path)))
    assert "nothing found" in printed(*command)
    report = json.loads(texts(*command, "--depth-scale", 100, "--json", status=1)[0])
    assert [finding["code"] for finding in report["findings"]] == ["depth-unit"]
    assert "1000" in report["findings"][0]["advice"] and report["notes"]
    assert texts(*command, "--depth-scale", 100, status=1)[0].startswith("depth-unit: ")
    assert "--mesh-scale is 0.001" in refused(*command, "--mesh-scale", 0.001)
    assert "no such folder" in refused(*command, "--meshes", tmp_path / "absent")
    files.color.unlink()
    assert f"{files.color} is missing" in refused(*command, "--json")


def test_folders_of_frames_and_scenes_of_bop(tmp_path: Path, texts: Texts, printed: Command) -> None:
    """The names in labels.json tell which mesh an object is compared with; a frame that is missing files fails."""
    for name in ("breakfast", "tools"):
        shutil.copytree(SAMPLES / name, tmp_path / "frames" / name)
    frame = frame_files(tmp_path / "frames" / "tools").read()
    names = {label: f"object{label}" for label in frame.instances}
    (tmp_path / "frames" / "tools" / "labels.json").write_text(json.dumps({"labels": names}))
    for label, extent in {**instance_extents(frame), 99: 0.6}.items():
        write_box(tmp_path / "meshes" / f"{names.get(label, 'large')}.ply", (extent, extent / 2, extent / 3))
    command = ("doctor", tmp_path / "frames", "--meshes", tmp_path / "meshes", "--json")
    assert [line["frame"] for line in json_lines(printed(*command))] == ["breakfast", "tools"]
    camera = tmp_path / "frames" / "tools" / "intrinsics.json"
    values = json.loads(camera.read_text())
    camera.write_text(json.dumps(values | {"fx": values["fx"] / 2, "fy": values["fy"] / 2}))
    reports = json_lines(texts(*command, status=1)[0])
    assert [[finding["code"] for finding in report["findings"]] for report in reports] == [[], ["intrinsics-focal"]]
    out = printed("doctor", tmp_path / "frames")
    assert out.startswith("breakfast:\n") and "\ntools: as breakfast\n" in out
    out, _ = texts("doctor", write_bop(tmp_path / "000001"), "--json", status=1)  # its images have few pixels
    assert [line["frame"] for line in json_lines(out)] == ["000001/000001"]
    frame_files(tmp_path / "frames" / "breakfast").color.unlink()
    out, err = texts(*command, status=2)
    assert [report["frame"] for report in json_lines(out)] == ["tools"]
    assert "failed: breakfast: " in err and "error: 1 of 2 frames" in err
    color = frame_files(tmp_path / "frames" / "breakfast").color
    color.mkdir()
    assert f"failed: breakfast: {color}: Is a directory\n" in texts(*command, status=2)[1]
