"""Diagnosis of set-ups: silence on sound frames, and the right finding on damaged ones (the page's sample frames)."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import Command, encode_image, json_lines, run_thor2, write_box
from PIL import Image

import thor2_jax
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject
from thor2_jax.model.recognition import Recognition
from training.diagnosis import registration
from training.diagnosis.checks import Diagnosis, check_camera, check_labels, check_meshes
from training.diagnosis.colors import check_channel_order, check_light
from training.diagnosis.depth import check_depth, instance_extents
from training.diagnosis.setup import diagnose
from training.readers.frame_files import FrameFiles, frame_files

SAMPLES = Path(thor2_jax.__file__).parent / "service" / "page" / "samples"
NAMES = ("breakfast", "clutter", "crockery", "tools")


@pytest.fixture(scope="module")
def frame() -> RGBDFrame:
    return frame_files(SAMPLES / "breakfast").read()


def codes(check: Callable[[Diagnosis], Any]) -> list[str]:
    """Return the codes of what a check finds."""
    diagnosis = Diagnosis()
    check(diagnosis)
    assert all(finding.message.endswith(".") and finding.advice.endswith(".") for finding in diagnosis.findings)
    return [finding.code for finding in diagnosis.findings]


@pytest.mark.parametrize("name", NAMES)
def test_sound_frames_have_no_findings(name: str) -> None:
    diagnosis = diagnose(frame_files(SAMPLES / name))
    assert diagnosis.findings == [] and any("--model" in note for note in diagnosis.notes)


def test_sound_frames_without_labels_have_no_findings() -> None:
    assert diagnose(dataclasses.replace(frame_files(SAMPLES / "tools"), labels=None)).findings == []


# Intrinsics


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, []),
        ({"cx": 330, "cy": 225}, []),
        ({"width": 640, "height": 480}, []),
        ({"width": 1280, "height": 720}, ["intrinsics-size"]),
        ({"cx": 640, "cy": 480}, ["intrinsics-size"]),
        ({"cx": 160, "cy": 120}, ["intrinsics-size"]),
        ({"cx": 240, "cy": 320}, ["intrinsics-size"]),
        ({"fx": 900}, ["intrinsics-aspect"]),
        ({"fx": 3.6, "fy": 3.6}, ["intrinsics-focal"]),
        ({"fx": 6000, "fy": 6000}, ["intrinsics-focal"]),
    ],
)
def test_intrinsics(changes: dict[str, float], expected: list[str]) -> None:
    camera = Intrinsics(**{"fx": 570, "fy": 575, "cx": 319.5, "cy": 239.5, **changes})
    assert codes(lambda diagnosis: check_camera(diagnosis, camera, 640, 480)) == expected


def test_exchanged_principal_points_are_named() -> None:
    diagnosis = Diagnosis()
    check_camera(diagnosis, Intrinsics(570, 570, 239.5, 319.5), 640, 480)
    assert "exchanged" in diagnosis.findings[0].message


# Depth


def change(frame: RGBDFrame, **changes: Any) -> RGBDFrame:
    return dataclasses.replace(frame, **changes)


def with_scale(frame: RGBDFrame, scale: float) -> RGBDFrame:
    return change(frame, intrinsics=dataclasses.replace(frame.intrinsics, depth_scale=scale))


def without_instances(frame: RGBDFrame) -> RGBDFrame:
    return change(frame, labels=None)


DEPTH: dict[str, tuple[Callable[[RGBDFrame], RGBDFrame], list[str], str]] = {
    "sound": (lambda f: f, [], ""),
    "0.1 mm": (lambda f: with_scale(change(f, depth=(f.depth * 10).astype(np.uint16)), 1000), ["depth-unit"], "10000"),
    "mm as units of 0.2 mm": (lambda f: with_scale(f, 5000), ["distance"], "depth_scale is wrong"),
    "metres per unit": (lambda f: with_scale(f, 0.001), ["depth-unit"], "1000"),
    "floats in mm": (lambda f: change(f, depth=f.depth.astype(np.float32)), ["depth-unit"], "Divide it by 1000"),
    "floats in metres": (lambda f: change(f, depth=f.depth_m), [], ""),
    "no labels, metres per unit": (lambda f: without_instances(with_scale(f, 0.001)), ["depth-unit"], "1000"),
    "no labels, sound": (without_instances, [], ""),
    "no depth": (lambda f: change(f, depth=f.depth * 0), ["depth-missing"], ""),
    "little depth": (
        lambda f: change(f, depth=f.depth * (np.random.default_rng(0).random(f.depth.shape) < 0.1)),
        ["depth-missing"],
        "",
    ),
    "far": (
        lambda f: change(
            f,
            depth=(f.depth * 5).astype(np.uint16),
            intrinsics=dataclasses.replace(f.intrinsics, fx=f.intrinsics.fx * 5, fy=f.intrinsics.fy * 5),
        ),
        ["distance"],
        "0.5 to 1.5 m",
    ),
}


@pytest.mark.parametrize("name", DEPTH)
def test_depth(frame: RGBDFrame, name: str) -> None:
    damage, expected, advice = DEPTH[name]
    diagnosis = Diagnosis()
    check_depth(diagnosis, damage(frame))
    assert [finding.code for finding in diagnosis.findings] == expected
    assert all(advice in finding.advice for finding in diagnosis.findings)


def test_extents_of_a_tilted_plate() -> None:
    """A rectangle of 0.3 x 0.1 m that is turned by 40 degrees; percentiles cut 4 % off."""
    camera = Intrinsics(500, 500, 160, 120)
    points = backproject(np.full((240, 320), 0.8, np.float32), camera)
    angle = np.radians(40)
    along = points[..., 0] * np.cos(angle) + points[..., 1] * np.sin(angle)
    across = points[..., 1] * np.cos(angle) - points[..., 0] * np.sin(angle)
    labels = ((np.abs(along) < 0.15) & (np.abs(across) < 0.05)).astype(np.uint8)
    plate = RGBDFrame(np.zeros((240, 320, 3), np.uint8), points[..., 2], labels, camera)
    assert instance_extents(plate) == {1: pytest.approx(0.3 * 0.96, rel=0.02)}


def test_objects_are_compared_with_the_meshes(frame: RGBDFrame) -> None:
    sides = {str(label): extent for label, extent in instance_extents(frame).items()}
    tenths = {name: side / 10 for name, side in sides.items()}
    assert codes(lambda diagnosis: check_depth(diagnosis, frame, sides)) == []
    assert codes(lambda diagnosis: check_depth(diagnosis, frame, tenths)) == ["depth-unit"]
    untrusted = codes(lambda diagnosis: check_depth(diagnosis, frame, {"pin": 0.01}, trust_camera=False))
    assert untrusted == []


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("factor", [0.5, 0.6, 1.0])
def test_sizes_of_named_meshes_tell_the_focal_length(name: str, factor: float) -> None:
    sound = frame_files(SAMPLES / name).read()
    k = sound.intrinsics
    scaled = change(sound, intrinsics=dataclasses.replace(k, fx=k.fx * factor, fy=k.fy * factor))
    names = {label: str(label) for label in sound.instances}
    sides = {names[label]: 1.1 * extent for label, extent in instance_extents(sound).items()}
    diagnosis = Diagnosis()
    check_depth(diagnosis, scaled, {**sides, "a large object": 0.6}, names)
    assert [finding.code for finding in diagnosis.findings] == ([] if factor == 1 else ["intrinsics-focal"])


def test_sizes_without_names_tell_a_halved_focal_length(frame: RGBDFrame) -> None:
    k = frame.intrinsics
    halved = change(frame, intrinsics=dataclasses.replace(k, fx=k.fx / 2, fy=k.fy / 2))
    sides = {str(label): extent for label, extent in instance_extents(frame).items()}
    side = float(np.median(list(sides.values())))
    for meshes in (sides, {"median": side, "small": side / 3}):
        assert codes(lambda diagnosis, meshes=meshes: check_depth(diagnosis, frame, meshes)) == []
        halved_codes = codes(lambda diagnosis, meshes=meshes: check_depth(diagnosis, halved, meshes))
        assert halved_codes == ["intrinsics-focal"]


# Labels


def interpolated(labels: np.ndarray) -> np.ndarray:
    spread = Image.fromarray((labels * 40).astype(np.uint8))
    return np.asarray(spread.resize((100, 75)).resize((labels.shape[1], labels.shape[0]), Image.Resampling.BICUBIC))


def blobs(n: int) -> np.ndarray:
    labels = np.zeros((90, 120), np.uint8)
    for k in range(n):
        labels[10:40, 5 + 30 * k : 25 + 30 * k] = 1
    return labels


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda labels: labels, []),
        (lambda labels: labels.astype(np.int32) * 1000, []),
        (lambda labels: labels * 0, ["labels-empty"]),
        (lambda labels: labels + 1, ["labels-background"]),
        (interpolated, ["labels-thin"]),
        (lambda labels: np.random.default_rng(0).integers(0, 256, labels.shape).astype(np.uint8), ["labels-many"]),
        (lambda labels: blobs(1), []),
        (lambda labels: blobs(2), []),
        (lambda labels: blobs(3) * 255, ["labels-foreground"]),
    ],
)
def test_labels(frame: RGBDFrame, make: Callable[[np.ndarray], np.ndarray], expected: list[str]) -> None:
    labels = make(frame.label_image)
    actual = codes(lambda diagnosis: check_labels(diagnosis, labels))
    assert actual == expected or (make is interpolated and actual == ["labels-many"])


def test_a_mask_of_touching_objects(frame: RGBDFrame) -> None:
    """Their extents show that it is not one object."""
    labels = np.zeros(frame.depth.shape, np.uint8)
    labels[: labels.shape[0] * 2 // 3] = 255
    one = change(frame, labels=labels, depth=np.full(frame.depth.shape, 1000, np.uint16))
    assert codes(lambda diagnosis: check_depth(diagnosis, one)) == ["labels-foreground"]


# Registration


def zoomed(image: np.ndarray, factor: float) -> np.ndarray:
    height, width = image.shape
    size = round(width / factor), round(height / factor)
    left, top = (width - size[0]) // 2, (height - size[1]) // 2
    cut = Image.fromarray(image[top : top + size[1], left : left + size[0]])
    return np.asarray(cut.resize((width, height), Image.Resampling.NEAREST))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda depth: np.roll(depth, (0, 3), (0, 1)), ""),
        (lambda depth: np.roll(depth, (0, 20), (0, 1)), "pixels left"),
        (lambda depth: np.roll(depth, (-16, 0), (0, 1)), "pixels down"),
        (lambda depth: np.ascontiguousarray(depth[:, ::-1]), "mirrored"),
        (lambda depth: zoomed(depth, 1.15), "enlarged by a factor of 1.1"),
    ],
)
def test_registration(frame: RGBDFrame, damage: Callable[[np.ndarray], np.ndarray], expected: str) -> None:
    diagnosis = Diagnosis()
    registration.check_registration(diagnosis, frame.color, damage(frame.depth_m))
    assert [finding.code for finding in diagnosis.findings] == (["registration"] if expected else [])
    assert all(expected in finding.message for finding in diagnosis.findings)


@pytest.mark.parametrize(("right", "down"), [(0, 0), (11, -5), (-48, 48)])
def test_alignment_finds_a_known_shift(right: int, down: int) -> None:
    rng = np.random.default_rng(0)
    field = np.where(rng.random((130, 170)) < 0.05, np.exp(2j * rng.uniform(0, np.pi, (130, 170))), 0)
    field[:50], field[-50:], field[:, :50], field[:, -50:] = 0, 0, 0, 0
    alignment = registration.align_edges(field, np.roll(field, (down, right), (0, 1)))
    assert (alignment.right, alignment.down) == (right, down) and alignment.height > 10


def test_frames_without_edges_are_not_judged() -> None:
    diagnosis = Diagnosis()
    registration.check_registration(diagnosis, np.zeros((90, 120, 3), np.uint8), np.ones((90, 120)))
    assert diagnosis.findings == [] and "registration" in diagnosis.notes[0]
    registration.check_registration(diagnosis, np.zeros((90, 120, 3), np.uint8), np.zeros((90, 120)))
    assert diagnosis.findings == []


def test_labels_of_another_place(frame: RGBDFrame) -> None:
    moved = np.roll(frame.label_image, 25, axis=1)
    assert codes(lambda d: registration.check_labels_alignment(d, frame.color, frame.label_image)) == []
    assert codes(lambda d: registration.check_labels_alignment(d, frame.color, moved)) == ["labels-shifted"]


# Colours


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda color: color, []),
        (lambda color: color // 8, ["color-dark"]),
        (lambda color: np.minimum(color.astype(int) * 8, 255).astype(np.uint8), ["color-bright"]),
        (lambda color: np.repeat(color[..., :1], 3, axis=2), ["color-gray"]),
        (lambda color: (color * [1.0, 0.7, 0.25]).astype(np.uint8), ["color-cast"]),
    ],
)
def test_light(frame: RGBDFrame, damage: Callable[[np.ndarray], np.ndarray], expected: list[str]) -> None:
    assert codes(lambda diagnosis: check_light(diagnosis, damage(frame.color), frame.labels)) == expected


def recognizer_that_prefers(color: np.ndarray, classes: tuple[str, ...] = ("mug",), n: int = 3) -> Any:
    """Return a recognizer whose confidence falls with the distance of the colours."""

    def recognize(frame: RGBDFrame) -> list[Recognition]:
        distance = np.abs(frame.color.astype(float) - color).mean() / 255
        return [Recognition(label, "mug", float(np.exp(-8 * distance))) for label in range(1, n + 1)]

    return SimpleNamespace(recognize=recognize, classes=classes)


def test_exchanged_channels_are_found_by_a_model(frame: RGBDFrame) -> None:
    """Colours of the sample are multiplied so that red and blue differ."""
    color = (frame.color * [1.0, 0.8, 0.4]).astype(np.uint8)
    right, wrong = change(frame, color=color), change(frame, color=np.ascontiguousarray(color[..., ::-1]))
    recognizer = recognizer_that_prefers(color)
    assert codes(lambda diagnosis: check_channel_order(diagnosis, right, recognizer)) == []
    assert codes(lambda diagnosis: check_channel_order(diagnosis, wrong, recognizer)) == ["bgr"]
    dark = change(frame, color=color // 2)
    assert codes(lambda diagnosis: check_channel_order(diagnosis, dark, recognizer)) in ([], ["color-light"])
    for few in (recognizer_that_prefers(color, n=1), recognizer_that_prefers(color, ())):
        diagnosis = Diagnosis()
        check_channel_order(diagnosis, wrong, few)
        assert diagnosis.findings == [] and "not checked" in diagnosis.notes[0]


# Meshes


@pytest.mark.parametrize(
    ("side", "scale", "expected", "factor"),
    [
        (0.2, 1.0, [], ""),
        (200.0, 1.0, ["mesh-unit"], "--mesh-scale 0.001"),
        (200.0, 0.001, [], ""),
        (20.0, 1.0, ["mesh-unit"], "--mesh-scale 0.01"),
        (0.0002, 1.0, ["mesh-unit"], "--mesh-scale 1000"),
        (1e9, 1.0, ["mesh-unit"], "--mesh-scale"),
    ],
)
def test_units_of_meshes(tmp_path: Path, side: float, scale: float, expected: list[str], factor: str) -> None:
    diagnosis, path = Diagnosis(), write_box(tmp_path / "box.ply", (side, side / 2, side / 3))
    sides = check_meshes(diagnosis, {"box": path}, scale)
    assert [finding.code for finding in diagnosis.findings] == expected
    assert all(factor in finding.advice for finding in diagnosis.findings)
    assert sides == ({} if expected else {"box": pytest.approx(0.2)})


def test_meshes_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "bad.ply").write_text("no mesh")
    assert codes(lambda diagnosis: check_meshes(diagnosis, {"bad": tmp_path / "bad.ply"})) == ["mesh"]


# Whole set-ups


def copy_of(folder: Path, **contents: bytes) -> FrameFiles:
    """Copy a sample; `contents` replaces files by name."""
    files = frame_files(SAMPLES / "crockery")
    paths = {}
    for field in dataclasses.fields(files):
        source = getattr(files, field.name)
        paths[field.name] = folder / source.name
        paths[field.name].write_bytes(contents.get(field.name, source.read_bytes()))
    return FrameFiles(**paths)


def test_files_of_the_wrong_kind_are_findings(tmp_path: Path) -> None:
    original = frame_files(SAMPLES / "crockery").read()
    photo = encode_image(original.color)
    actual = {f.code for f in diagnose(copy_of(tmp_path, labels=photo, intrinsics=b"{}")).findings}
    assert actual == {"unreadable-labels", "unreadable-intrinsics"}
    actual = {f.code for f in diagnose(copy_of(tmp_path, color=b"", depth=photo)).findings}
    assert actual == {"unreadable-color", "unreadable-depth"}
    half = encode_image(np.ascontiguousarray(original.depth[::2, ::2]))
    assert "size" in {f.code for f in diagnose(copy_of(tmp_path, depth=half)).findings}


def test_missing_files_are_errors(tmp_path: Path) -> None:
    files = copy_of(tmp_path)
    files.depth.unlink()
    with pytest.raises(InputError, match=r"depth\.png is missing"):
        diagnose(files)


def options(files: FrameFiles) -> list[object]:
    return [part for name, path in dataclasses.asdict(files).items() for part in (f"--{name}", path)]


def test_the_command(tmp_path: Path, capfd: pytest.CaptureFixture[str], printed: Command, refused: Command) -> None:
    files = copy_of(tmp_path)
    assert "nothing found" in printed("doctor", *options(files))
    assert run_thor2("doctor", *options(files), "--depth-scale", 100, "--json") == 1
    report = json.loads(capfd.readouterr().out)
    assert [finding["code"] for finding in report["findings"]] == ["depth-unit"]
    assert "1000" in report["findings"][0]["advice"] and report["notes"]
    assert run_thor2("doctor", *options(files), "--depth-scale", 100) == 1
    assert capfd.readouterr().out.startswith("depth-unit: ")
    files.color.unlink()
    refused("doctor", *options(files), "--json")
    refused("doctor", *options(files), "--mesh-scale", 0.001)


def test_folders_of_frames(tmp_path: Path, capfd: pytest.CaptureFixture[str], printed: Command) -> None:
    """The names in labels.json tell which mesh an object is compared with; a frame that is missing files fails."""
    for name in ("breakfast", "tools"):
        shutil.copytree(SAMPLES / name, tmp_path / "frames" / name)
    frame = frame_files(tmp_path / "frames" / "tools").read()
    names = {label: f"object{label}" for label in frame.instances}
    (tmp_path / "frames" / "tools" / "labels.json").write_text(json.dumps({"labels": names}))
    for label, extent in {**instance_extents(frame), 99: 0.6}.items():
        path = tmp_path / "meshes" / f"{names.get(label, 'large')}.ply"
        write_box(path, (extent, extent / 2, extent / 3))
    command = ("doctor", tmp_path / "frames", "--meshes", tmp_path / "meshes", "--json")
    assert [line["frame"] for line in json_lines(printed(*command))] == ["breakfast", "tools"]
    camera = tmp_path / "frames" / "tools" / "intrinsics.json"
    values = json.loads(camera.read_text())
    camera.write_text(json.dumps(values | {"fx": values["fx"] / 2, "fy": values["fy"] / 2}))
    assert run_thor2(*command) == 1
    reports = json_lines(capfd.readouterr().out)
    assert [[finding["code"] for finding in report["findings"]] for report in reports] == [[], ["intrinsics-focal"]]
    assert printed("doctor", tmp_path / "frames" / "tools").startswith("tools:\n")
    frame_files(tmp_path / "frames" / "breakfast").color.unlink()
    assert run_thor2(*command) == 2
    out, err = capfd.readouterr()
    assert [report["frame"] for report in json_lines(out)] == ["tools"]
    assert "failed: breakfast: " in err and "error: 1 of 2 frames" in err


def test_scenes_of_bop(tmp_path: Path, printed: Command) -> None:
    scene, frame = tmp_path / "000001", frame_files(SAMPLES / "breakfast").read()
    k, label = frame.intrinsics, frame.instances[0]
    for folder, name, pixels in (
        ("rgb", "000000.png", frame.color),
        ("depth", "000000.png", frame.depth),
        ("mask_visib", "000000_000000.png", (frame.labels == label).astype(np.uint8)),
    ):
        (scene / folder).mkdir(parents=True)
        (scene / folder / name).write_bytes(encode_image(pixels))
    camera = {"cam_K": [k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1], "depth_scale": 1000 / k.depth_scale}
    (scene / "scene_camera.json").write_text(json.dumps({"0": camera}))
    (scene / "scene_gt.json").write_text(json.dumps({"0": [{"obj_id": 1}]}))
    assert [line["frame"] for line in json_lines(printed("doctor", scene, "--json"))] == ["000001/000000"]


def test_frames_and_files_exclude_each_other(refused: Command) -> None:
    for arguments, expected in (
        ((), "give either FRAME"),
        ((SAMPLES, "--color", "c.png"), "give either FRAME"),
        (("--color", "c.png"), "--depth, --intrinsics is missing"),
    ):
        assert expected in refused("doctor", *arguments)
