"""OCID, Object Clutter Indoor Dataset (Suchi et al., 2019), subset YCB10: each frame of a sequence adds one object.

`{table,floor}/{bottom,top}/{cuboid,curved,mixed}/<sequence>/{rgb,depth,label,pcd}`; 640 x 480, depth in millimetres.
Two cameras record each sequence, the lower (`bottom`) and the upper (`top`) one. The dataset does not name its objects.
A YAML or JSON file gives the names: sequence -> names in the order of placement, which is the order of the labels:

    seq36: [mug, bowl, banana]                      # of both cameras
    table/top/mixed/seq21: [bowl, tomato_soup]      # the sequence's folder, or the end of its path

The tables of OCID-VLG (Tziafas et al., 2023) can be used, too: a JSON list of {"image_filename": "sequence,image",
"answer": label, "target": name, ...}. Only the frames in such a table are read, and labels without a name in it are
not scored.

The dataset has no intrinsics. They are fitted to the organized point cloud of each frame, in which each point lies on
the ray of its pixel.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError, decoding, with_context
from thor2_jax.files import as_path, read_file, read_table
from thor2_jax.frames.frames import Intrinsics, RGBDFrame, read_color, read_depth, read_labels
from training.readers.labelled import LabelledFrames, path_ends, sequence_of

__all__ = ["OCID", "fit_intrinsics", "read_organized_points"]

_FIRST_OBJECT = {"table": 3, "floor": 2}
"""Label of the first placed object. Label 0 marks pixels without depth, 1 the surroundings, and 2 the table, if any."""

_CAMERAS = {"bottom": "lower", "top": "upper"}

_LARGEST_RESIDUAL = 5.0
"""Largest root mean square residual of the fit, pixels: about 1 from sensor noise, hundreds for other clouds."""


class OCID(LabelledFrames):
    """The frames of the subset, by sequence and time.

    The ground truth of a frame contains the objects with at least one pixel.
    """

    def __init__(self, path: str | Path, names: str | Path) -> None:
        """Find the frames and the names of their objects.

        Args:
            path: folder `YCB10` or its parent folder.
            names: YAML or JSON file, see the module.

        Raises:
            InputError: there are no frames, or `names` is damaged, lacks sequences (listed in the message), or is a
                table of OCID-VLG without any of the frames.
            OSError: `names` cannot be opened.
        """
        path = self.dataset_folder(path)
        root = path / "YCB10" if (path / "YCB10").is_dir() else path
        images: dict[str, Path] = {}  # <place>/<camera>/<type>/<sequence>/<image> -> file
        for place, camera in itertools.product(_FIRST_OBJECT, _CAMERAS):
            files = sorted((root / place / camera).glob("*/*/rgb/*.png"))
            images |= {f"{file.parents[1].relative_to(root).as_posix()}/{file.stem}": file for file in files}
        if not images:
            raise InputError(f"dataset: {path} has no {{table,floor}}/{{bottom,top}}/<type>/<sequence>/rgb/*.png")
        names = as_path(names, "names")
        value = read_table(names, (dict, list))
        self._is_complete = not isinstance(value, list)
        if isinstance(value, list):
            self._names, listed = _names_of_vlg(names, value)
            images = {image: file for image, file in images.items() if not listed.isdisjoint(path_ends(image))}
            if not images:
                raise InputError(f"{names} lists no frame of {path}; expected image_filename <sequence>,<image>")
        else:
            self._names = _names_in_order(names, value, dict.fromkeys(map(sequence_of, images)))
        self.identifiers, self.sources = list(images), list(images.values())

    def read(self, number: int) -> tuple[RGBDFrame, dict[int, str], dict[str, str]]:
        """Read a frame, its names, and the place, the camera and the type of its sequence.

        Raises:
            InputError: the cloud does not fit a pinhole camera, or a label has no name; also as indexing.
        """
        sequence = sequence_of(self.identifiers[number])
        image, depth_file, label_file, cloud_file = self.files(number)
        place, camera, kind, _ = sequence.split("/")
        first_object = _FIRST_OBJECT[place]
        names = next(self._names[end] for end in path_ends(sequence) if end in self._names)
        color, labels, points = read_color(image), read_labels(label_file), read_organized_points(cloud_file)
        with with_context(str(cloud_file)):
            if points.shape[:2] != color.shape[:2]:
                raise InputError(f"the cloud has {points.shape[:2]} points, color {color.shape[:2]} (rows, columns)")
            intrinsics = fit_intrinsics(points)
        frame = RGBDFrame(color, read_depth(depth_file), labels * (labels >= first_object), intrinsics)
        unnamed = [label for label in frame.instances if label not in names]
        if unnamed and self._is_complete:
            raise InputError(
                f"{label_file} has the label {unnamed[0]}; the sequence has {len(names)} names, for the labels "
                f"from {first_object} on"
            )
        truth = {label: names[label] for label in frame.instances if label in names}
        return frame, truth, {"place": place, "camera": _CAMERAS[camera], "type": kind}

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame."""
        image = self.sources[number]
        others = (f"depth/{image.name}", f"label/{image.name}", f"pcd/{image.stem}.pcd")
        return [image, *(image.parents[1] / other for other in others)]

    def names(self) -> set[str]:
        """Return the names of the objects in the table."""
        return {name for names in self._names.values() for name in names.values()}


def _names_in_order(path: Path, table: Mapping[Any, Any], sequences: Iterable[str]) -> dict[str, dict[int, str]]:
    """Return label -> name for each sequence; the entry of a sequence is the longest end of its path in the table."""
    named: dict[str, dict[int, str]] = {}
    lacking = []
    for sequence in sequences:
        key = next((end for end in path_ends(sequence) if end in table), None)
        if key is None:
            lacking.append(sequence)
            continue
        names = table[key]
        if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
            raise InputError(f"{path}: {key} is {names!r}; expected a list of names")
        named[sequence] = dict(enumerate(names, start=_FIRST_OBJECT[sequence.split("/")[0]]))
    if lacking:
        raise InputError(f"{path} lacks the sequences {', '.join(lacking)}")
    return named


def _names_of_vlg(path: Path, items: Sequence[Any]) -> tuple[dict[str, dict[int, str]], set[str]]:
    """Return sequence -> label -> name, and the images <sequence>/<stem>, from a table of OCID-VLG.

    All images of a sequence share the names, since labels number its objects in the order of placement.
    """
    names: dict[str, dict[int, str]] = {}
    images: set[str] = set()
    for position, item in enumerate(items):
        try:
            file, answer, target = item["image_filename"], item["answer"], item["target"]
            folder, image = file.split(",")
            label = int(answer)
            if isinstance(answer, (bool, float)) or not isinstance(target, str) or not target:
                raise ValueError
        except (TypeError, KeyError, ValueError, AttributeError):
            raise InputError(
                f"{path}: item {position} is {str(item)[:200]}; expected image_filename <sequence>,<image>, answer "
                "<label> and target <name>"
            ) from None
        sequence = "/".join(folder.strip().strip("/").split("/")[-4:])
        known = names.setdefault(sequence, {}).setdefault(label, target)
        if known != target:
            raise InputError(
                f"{path}: label {label} of {sequence} has the names {known!r} and {target!r}; expected one"
            )
        images.add(f"{sequence}/{Path(image.strip()).stem}")
    return names, images


def fit_intrinsics(points: NDArray[np.float64]) -> Intrinsics:
    """Fit a pinhole camera to an organized cloud [H, W, 3] in the OpenCV camera frame; points without depth are NaN.

    Least-squares fits of x / z = (column - cx) / fx over the columns and of y / z over the rows. Only the ratios have
    errors, not the pixels: in the dataset's clouds z is a mean over time, x and y are not.

    Raises:
        InputError: there are too few points, or they do not lie on the rays of a pinhole camera; the message has the
            fit.
    """
    row, column = np.nonzero(np.isfinite(points).all(axis=-1) & (points[..., 2] > 0))
    if len(row) == 0 or np.ptp(row) == 0 or np.ptp(column) == 0:
        raise InputError(f"the cloud has {len(row)} points with depth; expected several rows and columns of them")
    x, y, z = points[row, column].T
    with np.errstate(all="ignore"):  # a degenerate fit shows in its values
        fx, cx, across = _line(column, x / z)
        fy, cy, down = _line(row, y / z)
    if not (fx > 0 and fy > 0 and max(across, down) < _LARGEST_RESIDUAL):
        raise InputError(
            f"the cloud is not that of a pinhole camera: fx {fx:g}, fy {fy:g}, residuals {across:g} and {down:g} pixels"
        )
    return Intrinsics(fx, fy, cx, cy)


def _line(pixel: NDArray[np.intp], ratio: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return focal length, principal point and root mean square residual, in pixels."""
    centred = pixel - pixel.mean()
    slope = np.mean(centred * ratio) / np.var(pixel)
    residual = ratio - ratio.mean() - slope * centred
    focal = 1 / slope
    return float(focal), float(pixel.mean() - ratio.mean() * focal), float(np.sqrt(np.mean(residual**2)) * abs(focal))


_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_organized_points(path: str | Path) -> NDArray[np.float64]:
    """Read the points [HEIGHT, WIDTH, 3] of a PCD file in the file's unit (usually metres); missing points are NaN.

    Fields other than x, y and z are ignored.

    Raises:
        InputError: the file is damaged or compressed, or has no x, y and z; the message names the file.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    content = read_file(path)
    header, start = _header(content, path)
    expected = "WIDTH x HEIGHT points with one number for each axis"
    with decoding(f"{path}: its header does not describe points with x, y and z", expected):
        fields = header["FIELDS"]
        counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
        types = [f"<{_KINDS[kind]}{int(size)}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        record = np.dtype([(f"{i}", t, (n,)) for i, (_, t, n) in enumerate(zip(fields, types, counts, strict=True))])
        axes = [fields.index(name) for name in "xyz"]
        width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
        (encoding,) = header["DATA"]
        if min(width, height) < 1 or any(counts[axis] != 1 for axis in axes):
            raise ValueError("no points, or several numbers for an axis")
    if encoding not in ("ascii", "binary"):
        raise InputError(f"{path} has DATA {encoding}; expected ascii or binary")
    data, n = content[start:], width * height
    try:
        if encoding == "ascii":
            numbers = np.array(data.split(), np.float64).reshape(n, sum(counts))
            return numbers[:, [sum(counts[:axis]) for axis in axes]].reshape(height, width, 3)
        records = np.frombuffer(data, record, count=n)
    except (ValueError, OverflowError):
        raise InputError(f"{path} does not hold {n} points of {sum(counts)} numbers, or is cut off") from None
    with np.errstate(invalid="ignore"):  # the data may contain signalling NaN
        points = [records[f"{axis}"][:, 0].astype(np.float64) for axis in axes]
    return np.stack(points, axis=-1).reshape(height, width, 3)


def _header(content: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Return the lines of the header (first word -> other words) and the offset of the data."""
    end = content.find(b"\n", content.find(b"\nDATA") + 1)
    lines = [line.split() for line in content[: max(end, 0)].decode("ascii", errors="replace").splitlines()]
    header = {words[0]: words[1:] for words in lines if words}
    if "DATA" not in header:
        raise InputError(f"{path} is not a PCD file; expected a line DATA")
    return header, end + 1
