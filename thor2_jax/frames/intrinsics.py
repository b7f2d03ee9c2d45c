"""Cameras: intrinsics, read from common formats, and lens distortion; docs/frames.md shows an example of each format.

| format | recognized by | depth_scale in it, if any |
|---|---|---|
| THOR2 | fx, fy, cx, cy | depth units per metre |
| BOP camera.json | fx, fy, cx, cy, width, height and a depth_scale from 0.01 to 10 | millimetres per depth unit |
| BOP scene_camera.json | cam_K, or image number -> entry with cam_K | millimetres per depth unit |
| RealSense | ppx, ppy | metres per depth unit |
| ROS camera_info | camera_matrix with data, or K (ROS 2: k) with D or distortion_model | depth units per metre |
| Open3D | intrinsic_matrix (column by column) | depth units per metre |
| 3 x 3 matrix | K, camera_matrix or the nine numbers alone, as JSON, YAML, text or NPY | depth units per metre |
"""

import codecs
import dataclasses
import io
import math
import re
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError, as_array, decoding, with_context
from thor2_jax.files import as_path, parse_json, parse_yaml, read_file, read_npy
from thor2_jax.printable import first_names

__all__ = [
    "DEFAULT_DEPTH_SCALE",
    "Intrinsics",
    "check_camera",
    "distort",
    "parse_intrinsics",
    "read_intrinsics",
    "undistort",
]

DEFAULT_DEPTH_SCALE = 1000.0

LARGEST_INTRINSIC = 10**9
"""Largest absolute value accepted for an intrinsic parameter."""

BOP_CAMERA_SCALES = 0.01, 10.0
"""Range of depth_scale in BOP's camera.json; other values beside fx, fy, cx and cy are depth units per metre."""

MAX_TEXT_BYTES = 2**16
"""Largest NPY file, text or YAML document that is read as intrinsics."""

DISTORTION_LENGTHS = (0, 4, 5, 8)
"""Numbers of coefficients: none, OpenCV's polynomial (ROS: plumb_bob) without and with k3, and its rational model."""

MAX_DISTORTION_ERROR = 0.5
"""Largest error of the inverse of a lens distortion, pixels."""

_ITERATIONS = 30
"""Steps of the iteration that inverts a lens distortion."""

_PINHOLE = ("fx", "fy", "cx", "cy")
_PINHOLE_MODELS = ("", "none", "plumb_bob", "rational_polynomial", "brown_conrady", "opencv", "radtan", "pinhole")
"""Distortion models with OpenCV's coefficients; other models are refused unless all coefficients are 0."""

_COEFFICIENTS = "distortion distortion_coefficients distortion_coeffs D d coeffs distCoeffs dist_coeffs dist_coeff dist"
_MESSAGE_FIELDS = ("width", "height", "distortion_model", "D", "d", "K", "k")

Array = NDArray[np.floating[Any]]


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, Real) and not isinstance(value, bool)
    return is_real and bool(abs(value) <= LARGEST_INTRINSIC)


def _checked_number(name: str, value: Any, least: float = 1 / LARGEST_INTRINSIC) -> float:
    """Return a number as a float, since sums of small NumPy integers overflow; raise InputError if it is out of range.

    Focal lengths and depth scales below the default of `least` would make points infinite.
    """
    if not _is_number(value) or value < least:
        raise InputError(f"{name} is {value!r}; expected a number from {least:.0e} to {LARGEST_INTRINSIC:.0e}")
    return float(value)


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera, with or without lens distortion; pixel centres have integer coordinates.

    Attributes:
        fx: focal length along a row, pixels.
        fy: focal length along a column, pixels.
        cx: column of the principal point, pixels.
        cy: row of the principal point, pixels.
        depth_scale: depth units per metre; 1000 if depth is in millimetres.
        width: columns of the images, if known; `RGBDFrame` checks it.
        height: rows of the images, if known.
        distortion: 0, 4, 5 or 8 coefficients in the order of OpenCV: k1, k2, p1, p2, then k3, then k4, k5, k6.

    Raises:
        InputError: a value is not a finite number or exceeds `LARGEST_INTRINSIC`, a focal length or the depth scale is
            below 1 / `LARGEST_INTRINSIC`, a size is not positive, or the number of coefficients is not supported.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    depth_scale: float = DEFAULT_DEPTH_SCALE
    width: int | None = None
    height: int | None = None
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in (*_PINHOLE, "depth_scale"):
            least = -LARGEST_INTRINSIC if name in ("cx", "cy") else 1 / LARGEST_INTRINSIC
            object.__setattr__(self, name, _checked_number(f"intrinsics.{name}", getattr(self, name), least))
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, Integral) or isinstance(value, bool) or value <= 0):
                raise InputError(f"intrinsics.{name} is {value!r}; expected a positive integer, in pixels")
        object.__setattr__(self, "distortion", _coefficients(self.distortion))

    def with_depth_scale(self, depth_scale: float | None) -> "Intrinsics":
        """Return the camera with another depth scale (None: with its own); raise InputError if it is out of range."""
        if depth_scale is None:
            return self
        return dataclasses.replace(self, depth_scale=_checked_number("depth_scale", depth_scale))

    @classmethod
    def of(cls, values: Any) -> "Intrinsics":
        """Create intrinsics from a mapping (other entries are ignored), a matrix or a ROS message in a format above.

        Raises:
            InputError: `values` is in none of the formats, lacks an entry, has an invalid entry, or has a lens
                distortion that is not supported.
        """
        if isinstance(values, Intrinsics):
            return values
        if hasattr(values, "__array__") or (isinstance(values, Sequence) and not isinstance(values, (str, bytes))):
            return cls.of_matrix(values)
        if hasattr(values, "distortion_model"):  # a CameraInfo message
            values = {name: getattr(values, name) for name in _MESSAGE_FIELDS if hasattr(values, name)}
        if not isinstance(values, Mapping):
            raise InputError(f"intrinsics is of type {type(values).__name__}; expected fx, fy, cx, cy, or a matrix")
        camera = values["intrinsic"] if isinstance(values.get("intrinsic"), Mapping) else values  # of Open3D
        matrix, scale = _parts(camera)
        scale = DEFAULT_DEPTH_SCALE if scale is None else scale
        width, height = _entry(camera, "width", "image_width"), _entry(camera, "height", "image_height")
        distortion = next(filter(_is_given, map(_distortion, (camera, values))), ())
        return cls.of_matrix(matrix, scale, width=width, height=height, distortion=distortion)

    @classmethod
    def of_matrix(
        cls,
        matrix: Any,
        depth_scale: float = DEFAULT_DEPTH_SCALE,
        *,
        width: int | None = None,
        height: int | None = None,
        distortion: Any = (),
    ) -> "Intrinsics":
        """Create intrinsics from the nine numbers of a camera matrix, row by row.

        Raises:
            InputError: `matrix` is not of the form fx, 0, cx, 0, fy, cy, 0, 0, 1, or a value is invalid.
        """
        try:
            fx, skew, cx, a, fy, cy, b, c, one = as_array(matrix, "intrinsics", dtype=object).ravel().tolist()
        except (TypeError, ValueError):
            skew = None
        if skew is None or [skew, a, b, c, one] != [0, 0, 0, 0, 1]:
            raise InputError(f"intrinsics is {matrix}; expected a 3 x 3 matrix fx, 0, cx, 0, fy, cy, 0, 0, 1")
        return cls(fx, fy, cx, cy, depth_scale, width, height, distortion)


def _coefficients(distortion: Any) -> tuple[float, ...]:
    """Check the coefficients of a lens distortion and return them, or none if all are 0."""
    is_sequence = isinstance(distortion, Sequence) and not isinstance(distortion, (str, bytes))
    if not (is_sequence or hasattr(distortion, "__array__")):
        raise InputError(f"intrinsics.distortion is {distortion!r}; expected a list of coefficients")
    values = as_array(distortion, "intrinsics.distortion", "coefficients", object).ravel().tolist()
    for value in values:
        if not _is_number(value):
            raise InputError(f"intrinsics.distortion has the coefficient {value!r}; expected finite numbers")
    if not any(values):
        return ()
    if not any(values[DISTORTION_LENGTHS[-1] :]):
        values = values[: DISTORTION_LENGTHS[-1]]
    if len(values) not in DISTORTION_LENGTHS:
        raise InputError(
            f"intrinsics.distortion has {len(values)} coefficients; expected k1, k2, p1, p2[, k3[, k4, k5, k6]]; for "
            "other lenses, rectify the images and give the intrinsics of the rectified images"
        )
    return tuple(float(value) for value in values)


def _terms(x: Array, y: Array, coefficients: Sequence[float]) -> tuple[Array, Array, Array]:
    """Return the radial factor and both tangential terms of OpenCV's polynomial or rational model.

    Coordinates, here and below, are x / z and y / z in the camera frame; the coefficients are `Intrinsics.distortion`.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    squared = x * x + y * y
    radial = (1 + squared * (k1 + squared * (k2 + squared * k3))) / (1 + squared * (k4 + squared * (k5 + squared * k6)))
    product = 2 * x * y
    return radial, p1 * product + p2 * (squared + 2 * x * x), p1 * (squared + 2 * y * y) + p2 * product


def distort(x: Array, y: Array, coefficients: Sequence[float]) -> tuple[Array, Array]:
    """Return the image coordinates of directions (x, y), which are the coordinates in an ideal pinhole camera."""
    radial, tangential_x, tangential_y = _terms(x, y, coefficients)
    return x * radial + tangential_x, y * radial + tangential_y


def undistort(x: Array, y: Array, coefficients: Sequence[float]) -> tuple[Array, Array]:
    """Return the inverse of `distort` at (x, y), computed by fixed-point iteration.

    Where the model has no inverse, the result is arbitrary, and `distort` does not map it to (x, y).
    """
    ideal_x, ideal_y = x, y
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            radial, tangential_x, tangential_y = _terms(ideal_x, ideal_y, coefficients)
            ideal_x, ideal_y = (x - tangential_x) / radial, (y - tangential_y) / radial
    return ideal_x, ideal_y


def check_camera(intrinsics: Intrinsics, height: int, width: int) -> None:
    """Raise InputError unless the camera fits images of this size."""
    size = intrinsics.width or width, intrinsics.height or height
    if size != (width, height):
        raise InputError(
            f"intrinsics is for images of {size[0]} x {size[1]} pixels; color has {width} x {height}; expected the "
            "intrinsics of this image size"
        )
    if not intrinsics.distortion:
        return
    row, column = np.meshgrid(np.linspace(0, height - 1, 17), np.linspace(0, width - 1, 17))
    x, y = (column - intrinsics.cx) / intrinsics.fx, (row - intrinsics.cy) / intrinsics.fy
    with np.errstate(all="ignore"):
        again_x, again_y = distort(*undistort(x, y, intrinsics.distortion), intrinsics.distortion)
        pixels = np.hypot((again_x - x) * intrinsics.fx, (again_y - y) * intrinsics.fy).max()
    if not pixels < MAX_DISTORTION_ERROR:
        raise InputError(
            f"intrinsics has the distortion {list(intrinsics.distortion)}, which has no inverse within the image; "
            "rectify the images and give the intrinsics of the rectified images"
        )


def _is_given(coefficients: Any) -> bool:
    """Return whether there are coefficients of which one is not 0."""
    return bool(np.any(as_array(coefficients, "intrinsics.distortion", "coefficients", object)))


def _distortion(values: Mapping[Any, Any]) -> Any:
    """Return the coefficients of a lens distortion, under any of their names in any format.

    Raises:
        InputError: the distortion model is not supported and a coefficient is not 0.
    """
    one_by_one = [values.get(name, 0) for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
    distortion = next(filter(_is_given, (_entry(values, name) for name in _COEFFICIENTS.split())), one_by_one)
    # fisheye_model is of OpenCV. Lenses with k4 and without k5 are fisheyes, too: the rational model has k4 to k6.
    is_fisheye = values.get("fisheye_model") or (values.get("k4") and "k5" not in values)
    model = "fisheye" if is_fisheye else _entry(values, "distortion_model", "model")
    name = str(model or "").lower().rpartition(".")[2]  # RealSense: distortion.brown_conrady
    if name not in _PINHOLE_MODELS and _is_given(distortion):
        raise InputError(
            f"intrinsics has the distortion model {model}; expected plumb_bob or rational_polynomial; rectify "
            "the images and give the intrinsics of the rectified images"
        )
    return distortion


def _parts(values: Mapping[Any, Any]) -> tuple[Any, Any]:
    """Return a camera matrix row by row, and depth units per metre or None.

    The entries of a mapping determine its format.

    Raises:
        InputError: no format has these entries, or one is missing or invalid.
    """
    scale: Any = values.get("depth_scale")
    if "cam_K" in values:
        return values["cam_K"], _units_per_metre(scale, 1000, math.inf, "a positive number")
    if "intrinsic_matrix" in values:
        matrix = as_array(values["intrinsic_matrix"], "intrinsics.intrinsic_matrix", dtype=object).ravel()
        if matrix.size != 9 or any(matrix[[2, 5]]):  # with cx and cy there, it is given row by row
            raise InputError(
                f"intrinsics.intrinsic_matrix is {values['intrinsic_matrix']}; expected fx, 0, 0, 0, fy, 0, cx, cy, 1"
            )
        return matrix.reshape(3, 3).T, scale
    if "ppx" in values or "ppy" in values:
        scale = _units_per_metre(scale, 1, 1, "metres per depth unit, such as 0.001, since ppx and ppy are given")
        return _pinhole_matrix(values, "ppx", "ppy"), scale
    if (matrix := _entry(values, "camera_matrix", "K", "k")) is not None:  # K alone is a camera_info, too
        return matrix, scale
    if any(name in values for name in _PINHOLE):
        has_size = None not in (_entry(values, "width", "image_width"), _entry(values, "height", "image_height"))
        if has_size and _is_number(scale) and BOP_CAMERA_SCALES[0] <= scale <= BOP_CAMERA_SCALES[1]:
            scale = 1000 / scale  # BOP's camera.json
        return _pinhole_matrix(values, "cx", "cy"), scale
    shown, expected = first_names(list(map(str, values)), 8) or "no entry", "fx, fy, cx, cy, or a ROS camera_info, K"
    raise InputError(f"intrinsics has {shown}; expected {expected}, cam_K, ppx and ppy, or intrinsic_matrix")


def _pinhole_matrix(values: Mapping[Any, Any], column: str, row: str) -> list[Any]:
    """Return the matrix of focal lengths and a principal point, whose names are given."""
    names = ("fx", "fy", column, row)
    missing = [name for name in names if name not in values]
    if missing:
        raise InputError(f"intrinsics lacks {', '.join(missing)}; expected {', '.join(names)}")
    return [values["fx"], values.get("skew", 0), values[column], 0, values["fy"], values[row], 0, 0, 1]


def _units_per_metre(scale: Any, units: int, most: float, expected: str) -> float | None:
    """Return depth units per metre from the inverse in a file, with `units` in a metre; None without a scale."""
    if scale is not None and not (_is_number(scale) and 0 < scale < most):
        raise InputError(f"intrinsics.depth_scale is {scale!r}; expected {expected}")
    return None if scale is None else units / scale


def _entry(values: Mapping[Any, Any], *names: str) -> Any:
    """Return the first entry of these names that is not None; for a matrix in OpenCV's YAML, return its data."""
    value = next((values[name] for name in names if values.get(name) is not None), None)
    return value.get("data", value) if isinstance(value, Mapping) else value


def parse_intrinsics(content: bytes, image: int | None = None) -> Intrinsics:
    """Create intrinsics from the content of a file in one of the formats of this module.

    Args:
        content: JSON, YAML (the first of several documents), nine numbers as text, or NPY.
        image: number of the image, which selects the entry of a BOP scene_camera.json with several images.

    Raises:
        InputError: `content` is in none of the formats; also as `Intrinsics.of`.
    """
    values = _parse(content)
    entries = values.items() if isinstance(values, Mapping) else []
    is_image = [
        str(number).isdecimal() and isinstance(entry, Mapping) and "cam_K" in entry for number, entry in entries
    ]
    if is_image and all(is_image):
        numbers = {int(number): entry for number, entry in entries}
        if len(numbers) > 1 and image not in numbers:
            raise InputError(
                f"intrinsics has {len(numbers)} images and none has the number {image}; expected one that is the name "
                "of the color file, or a file with a single image"
            )
        values = numbers[image] if image in numbers else next(iter(numbers.values()))
    return Intrinsics.of(values)


def _parse(content: bytes) -> Any:
    """Return the value in a file, whose first bytes determine the format."""
    expected = "fx, fy, cx, cy or another known format"
    content = content.removeprefix(codecs.BOM_UTF8)  # written by editors on Windows
    if content.lstrip()[:1] in (b"{", b"["):
        with decoding("intrinsics is not valid JSON", expected):
            return parse_json(content)
    is_npy = content.startswith(b"\x93NUMPY")
    if not is_npy:
        # `ros2 topic echo` ends each message with a line ---.
        documents = re.split(rb"(?m)^---[ \t\r]*$", content)
        content = next((each for each in documents if re.search(rb"(?m)^(?![#%])[ \t]*\S", each)), content)
    if len(content) > MAX_TEXT_BYTES:
        raise InputError(f"intrinsics has {len(content)} bytes; expected at most {MAX_TEXT_BYTES}")
    if is_npy:
        with decoding("intrinsics is a damaged NPY file", "a 3 x 3 matrix"):
            return read_npy(io.BytesIO(content), MAX_TEXT_BYTES)
    words = re.sub(rb"#.*|,", b" ", content).split()
    if not words:
        raise InputError(f"intrinsics has no content; expected {expected}")
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        with decoding("intrinsics is neither JSON, YAML, NPY nor nine numbers", expected):
            # YAML parsers reject a directive and tags of OpenCV's FileStorage, and read 1e-05 of `rostopic` as text.
            content = re.sub(rb"(?<=[\s,[])([-+]?\d+)(?=[eE][-+]\d)", rb"\1.", content)
            values = parse_yaml(re.sub(rb"^%YAML.*\n|!!opencv-matrix", b"", content))
            if isinstance(values, str):
                raise ValueError(f"it begins with {content.decode(errors='replace')[:30]!r}") from None
            return values


def read_intrinsics(path: str | Path, image: int | None = None) -> Intrinsics:
    """Read intrinsics from a file, see `parse_intrinsics`.

    Raises:
        InputError: as `parse_intrinsics`; the message names the file.
        OSError: the file cannot be opened.
    """
    content = read_file(as_path(path, "intrinsics"))
    with with_context(str(path)):
        return parse_intrinsics(content, image)
