"""Intrinsics: each format as other software writes it, sizes, lens distortion, and invalid files."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from failures import Pickled
from image_files import encode_npy
from refusals import assert_refused

from thor2_jax.frames.frames import Intrinsics, RGBDFrame, backproject, frame_intrinsics, pixel_rays
from thor2_jax.frames.intrinsics import parse_intrinsics, read_intrinsics

MATRIX = np.array([[615.5, 0.0, 318.25], [0.0, 616.75, 241.5], [0.0, 0.0, 1.0]])
PINHOLE = {"fx": 615.5, "fy": 616.75, "cx": 318.25, "cy": 241.5}
DISTORTIONS = {
    "plumb_bob": (0.12, -0.23, 0.001, -0.002, 0.05),
    "without k3": (0.05, -0.1, 0.001, 0.002),
    "rational_polynomial": (0.45, -2.5, 0.0008, -0.0002, 1.4, 0.33, -2.3, 1.36),
}

ROS1_YAML = """\
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [615.5, 0, 318.25, 0, 616.75, 241.5, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [600, 0, 318, 0, 0, 600, 241, 0, 0, 0, 1, 0]}
"""

ROS1_ECHO = """\
height: 480
width: 640
distortion_model: "plumb_bob"
D: [0.0, 0.0, 0.0, 0.0, 0.0]
K: [615.5, 0.0, 318.25, 0.0, 616.75, 241.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [615.5, 0.0, 318.25, 0.0, 0.0, 616.75, 241.5, 0.0, 0.0, 0.0, 1.0, 0.0]
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""

ROS2_ECHO = ROS1_ECHO.replace("D:", "d:").replace("K:", "k:").replace("R:", "r:").replace("P:", "p:") + ROS1_ECHO


TEXT = b"6.155e+02 0.0e+00 3.1825e+02\n0.0e+00 6.1675e+02 2.415e+02\n0.0e+00 0.0e+00 1.0e+00\n"
"""The matrix in the notation of `np.savetxt`."""

IMAGES = np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint16), np.zeros((48, 64), np.uint8)
BOP_ENTRY = {"cam_K": MATRIX.ravel().tolist(), "depth_scale": 0.1, "cam_R_w2c": [1.0] * 9}
SIZE = {"width": 640, "height": 480}
REALSENSE = {**SIZE, "ppx": 318.25, "ppy": 241.5, "fx": 615.5, "fy": 616.75}
OPEN3D = {**SIZE, "intrinsic_matrix": [615.5, 0, 0, 0, 616.75, 0, 318.25, 241.5, 1]}
WITH_SIZE = PINHOLE | SIZE
SIZED = Intrinsics(**WITH_SIZE)


def as_json(values: object) -> bytes:
    return json.dumps(values).encode()


FORMATS: dict[str, tuple[bytes, Intrinsics]] = {
    "THOR2": (as_json({**PINHOLE, "depth_scale": 5000.0}), Intrinsics(**PINHOLE, depth_scale=5000.0)),
    "THOR2 in YAML": (yaml.safe_dump(PINHOLE).encode(), Intrinsics(**PINHOLE)),
    "ROS 1 calibration": (ROS1_YAML.encode(), SIZED),
    "ROS 1 message": (ROS1_ECHO.encode(), SIZED),
    "ROS 2 messages": (ROS2_ECHO.encode(), SIZED),
    "ROS 2 message in JSON": (as_json(next(yaml.safe_load_all(ROS2_ECHO))), SIZED),
    "K": (as_json({"K": MATRIX.tolist(), "depth_scale": 4000}), Intrinsics(**PINHOLE, depth_scale=4000)),
    "camera_matrix": (as_json({"camera_matrix": MATRIX.tolist()}), Intrinsics(**PINHOLE)),
    "nine numbers in JSON": (as_json(MATRIX.ravel().tolist()), Intrinsics(**PINHOLE)),
    "matrix in text with a comment": (b"\xef\xbb\xbf# K\r\n" + TEXT, Intrinsics(**PINHOLE)),
    "matrix in CSV": (b"615.5, 0, 318.25\n0, 616.75, 241.5\n0, 0, 1\n", Intrinsics(**PINHOLE)),
    "matrix in NPY": (encode_npy(np.asfortranarray(MATRIX.astype(np.float32))), Intrinsics(**PINHOLE)),
    "BOP entry": (as_json(BOP_ENTRY), Intrinsics(**PINHOLE, depth_scale=10_000)),
    "BOP scene": (as_json({"7": BOP_ENTRY}), Intrinsics(**PINHOLE, depth_scale=10_000)),
    "BOP camera.json": (as_json(WITH_SIZE | {"depth_scale": 0.1}), Intrinsics(**WITH_SIZE, depth_scale=10_000)),
    "metres per unit": (as_json(WITH_SIZE | {"depth_scale": 0.001}), Intrinsics(**WITH_SIZE, depth_scale=0.001)),
    "RealSense": (as_json({**REALSENSE, "model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}), SIZED),
    "RealSense with a scale": (as_json(REALSENSE | {"depth_scale": 0.00025}), Intrinsics(**WITH_SIZE, depth_scale=4e3)),
    "Open3D camera": (as_json({"intrinsic": OPEN3D, "extrinsic": [1.0] * 16}), SIZED),
}
LENS = [0.12, -2e-05, 1e-05, -0.002, 0.05]


@pytest.mark.parametrize("name", FORMATS)
def test_formats(name: str, tmp_path: Path) -> None:
    content, expected = FORMATS[name]
    (tmp_path / "k").write_bytes(content)
    assert read_intrinsics(tmp_path / "k") == expected


def test_a_file_of_opencv(tmp_path: Path) -> None:
    storage = cv2.FileStorage(str(tmp_path / "k.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.zeros((1, 5)))
    storage.release()
    assert read_intrinsics(tmp_path / "k.yml") == SIZED


COEFFICIENTS = "distortion distortion_coefficients distortion_coeffs D d coeffs distCoeffs dist_coeffs dist_coeff dist"


@pytest.mark.parametrize("name", COEFFICIENTS.split())
@pytest.mark.parametrize("camera", [PINHOLE, {"K": MATRIX.tolist()}, {"cam_K": MATRIX.tolist()}, REALSENSE, OPEN3D])
def test_coefficients_in_every_format(camera: dict[str, object], name: str) -> None:
    assert parse_intrinsics(as_json({**camera, name: LENS})).distortion == tuple(LENS)
    for refused in ({name: LENS, "model": "fisheye"}, {name: {"k1": 0.1}}, {name: LENS, "fisheye_model": 1}):
        assert_refused("^intrinsics.* distortion|^intrinsics.distortion", Intrinsics.of, {**camera, **refused})


def test_coefficients_beside_a_nested_camera() -> None:
    """Empty lists are passed over, and the lens of the camera itself comes first; matrix and scale are its own."""
    beside = {"D": [], "dist": LENS, "K": np.eye(3).tolist(), "depth_scale": 1}
    expected = Intrinsics.of({**OPEN3D, "dist": LENS})
    assert Intrinsics.of({"intrinsic": OPEN3D, **beside}) == expected
    own = {"intrinsic": {**OPEN3D, "dist": LENS}, "D": [0.5] * 5, "model": "Azure Kinect"}
    assert Intrinsics.of(own) == expected
    assert_refused("model Azure Kinect", Intrinsics.of, {**own, "intrinsic": OPEN3D})


def test_coefficients_one_by_one() -> None:
    """This is how the software of Azure Kinect and Orbbec lists them."""
    named = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), DISTORTIONS["rational_polynomial"], strict=True))
    assert Intrinsics.of(PINHOLE | named).distortion == DISTORTIONS["rational_polynomial"]
    assert_refused("3 x 3 matrix", Intrinsics.of, PINHOLE | {"skew": 0.5})
    assert_refused("model fisheye", Intrinsics.of, PINHOLE | {"k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": -0.01})


def test_rostopic_echo_omits_the_point_of_a_power_of_ten() -> None:
    echo = ROS1_ECHO.replace("D: [0.0, 0.0, 0.0, 0.0, 0.0]", f"D: {LENS}")
    assert "-2e-05, 1e-05" in echo
    assert parse_intrinsics(echo.encode()) == Intrinsics(**WITH_SIZE, distortion=tuple(LENS))


def test_the_entry_of_a_bop_scene_is_that_of_the_image(tmp_path: Path) -> None:
    entries = {str(n): {"cam_K": [500 + n, 0, 3, 0, 500, 2, 0, 0, 1], "depth_scale": 1.0} for n in (1, 12)}
    path = tmp_path / "scene_camera.json"
    path.write_text(json.dumps(entries))
    assert frame_intrinsics(path, tmp_path / "000012.png").fx == 512
    for name in ("000002.png", "color.png"):
        assert_refused("has 2 images and none has the number", frame_intrinsics, path, tmp_path / name)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# only a comment", "intrinsics has no content"),
        ("{", "is not valid JSON"),
        ("[" * 70_000, "is not valid JSON"),
        ("[500, 500, 3, 2]", "intrinsics is [500, 500, 3, 2]; expected a 3 x 3"),
        ("K: [1, 0, 3, 0, 2, 2, 0, 0]", "expected a 3 x 3 matrix fx"),
        ("615 0 318 7 616 241 0 0 1", "expected a 3 x 3 matrix fx"),
        ("615;0;318;0;616;241;0;0;1", "neither JSON, YAML, NPY nor nine numbers (it begins with '615;0"),
        ("a: [", "neither JSON, YAML"),
        ('{"ppx": 3, "ppy": 2, "fx": 5, "fy": 5, "depth_scale": 1000}', "metres per depth unit"),
        ('{"cam_K": [1, 0, 3, 0, 2, 2, 0, 0, 1], "depth_scale": 0}', "depth_scale is 0"),
        ('{"intrinsic_matrix": [1, 2, 3]}', "intrinsic_matrix is [1, 2, 3]"),
        ('{"intrinsic_matrix": [615, 0, 318, 0, 616, 241, 0, 0, 1]}', "expected fx, 0, 0, 0"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "width": 0}', "intrinsics.width is 0"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "height": "480"}', "intrinsics.height is '480'"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "distortion": [1, 2]}', "has 2 coefficients"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "distortion": [[1], [1, 2]]}', "has the coefficient"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "distortion": [1, 2, 3, NaN]}', "coefficient nan"),
        (json.dumps(PINHOLE | {"distortion": [1] * 15}), "has 15 coefficients"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "distortion": "none"}', "distortion is 'none'"),
        ('{"K": 0, "D": [0.1, 0], "distortion_model": "equidistant"}', "the distortion model equidistant; expected"),
        ('{"ppx": 3, "ppy": 2, "fx": 5, "fy": 5, "model": "a.inverse_brown", "coeffs": [1]}', "model a.inverse_brown"),
        (json.dumps({"a\nb": 1}), "has a b; expected"),
        ("{}", "has no entry"),
        ('{"fx": 5e-324, "fy": 5, "cx": 3, "cy": 2}', "intrinsics.fx is 5e-324"),
        ("x" * 100_000, "100000 bytes"),
        (json.dumps({"k" * 100_000: 1}), "kkk ... "),
    ],
)
def test_invalid_files(text: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "k").write_bytes(text.encode("latin-1"))
    path = tmp_path / "k"
    assert_refused(f"^(?=.{{,1009}}$).*{path}.*{re.escape(expected)}", read_intrinsics, path)


def test_invalid_npy_files() -> None:
    for content in (
        encode_npy(MATRIX)[:100],
        encode_npy(MATRIX[:2]),
        encode_npy(np.array([Pickled()] * 9, object)),
        encode_npy(MATRIX + 0j),
        encode_npy(np.zeros(9, "V0")).replace(b"(9,), }" + b" " * 13, b"(99999999999999,), }"),
    ):
        assert_refused(r"^intrinsics[ .]", parse_intrinsics, content)


def test_the_size_of_the_images_is_checked() -> None:
    for width, height in ((64, 48), (None, 48), (None, None)):
        RGBDFrame(*IMAGES, Intrinsics(60, 60, 32, 24, width=width, height=height))
    for width, height in ((128, 96), (48, 64), (64, 47)):
        message = rf"^intrinsics is for images of {width} x {height} pixels; color has 64 x 48"
        assert_refused(message, RGBDFrame, *IMAGES, Intrinsics(60, 60, 32, 24, width=width, height=height))


# Geometry


@pytest.mark.parametrize("distortion", [(), *DISTORTIONS.values()], ids=["none", *DISTORTIONS])
def test_points_of_pixels_project_to_them(distortion: tuple[float, ...]) -> None:
    """OpenCV projects the points."""
    camera = Intrinsics(61.5, 62.0, 31.25, 24.5, distortion=distortion)
    depth = np.random.default_rng(1).uniform(0.3, 2.0, (48, 64))
    assert backproject(depth.astype(np.float32), camera).dtype == np.float32
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = backproject(depth, camera).reshape(-1, 3)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion))[0]
    rows, columns = np.mgrid[:48, :64]
    np.testing.assert_allclose(pixels.reshape(48, 64, 2), np.stack([columns, rows], -1), atol=1e-3)
    some = np.array([0, 70, 3071])
    np.testing.assert_allclose(pixel_rays(some, 64, camera) * depth.ravel()[some, None], points[some], rtol=1e-9)
    np.testing.assert_array_equal(points[:, 2], depth.ravel())
    assert pixel_rays(some[:0], 64, camera).shape == (0, 3)


def test_masked_intrinsics_are_refused() -> None:
    masked = np.ma.masked_equal(MATRIX, 1)
    for values in (masked, {"K": masked}, {"intrinsic_matrix": masked.T}, PINHOLE | {"D": masked}):
        assert_refused("^intrinsics.*(--| masked)", Intrinsics.of, values)


def test_zero_coefficients_are_no_distortion() -> None:
    assert Intrinsics(**PINHOLE, distortion=[0.0] * 14).distortion == ()
    longer = [*DISTORTIONS["rational_polynomial"], 0, 0, 0, 0]
    assert Intrinsics(**PINHOLE, distortion=longer).distortion == DISTORTIONS["rational_polynomial"]


@pytest.mark.parametrize("distortion", [(-9, 0, 0, 0), (-0.148, 0, 0, 0), (0, 0, 80, 0), (0, 0, 0, 0, 0, -5, 0, 0)])
def test_distortion_without_an_inverse_is_refused(distortion: tuple[float, ...]) -> None:
    camera = Intrinsics(40, 40, 30, 22, distortion=distortion)
    assert_refused("^intrinsics has the distortion .*no inverse", RGBDFrame, *IMAGES, camera)
