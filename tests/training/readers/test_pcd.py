"""Valid and damaged PCD files."""

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers import input_error

from training.readers.ocid import read_organized_points

HEADER = (
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgba label\nSIZE 4 4 4 4 4\n"
    "TYPE F F F U U\nCOUNT 1 1 1 1 1\nWIDTH 3\nHEIGHT 2\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6\nDATA {}\n"
)
ROWS = [(0.5 * k, -0.25 * k, float("nan") if k == 4 else 1.0 + k, 0xFF102030, k) for k in range(6)]
POINTS = np.array([row[:3] for row in ROWS]).reshape(2, 3, 3)
DATA = {
    "binary": b"".join(struct.pack("<fffII", *row) for row in ROWS).replace(
        struct.pack("<f", float("nan")),
        struct.pack("<I", 0x7F800001),  # a signalling NaN
    ),
    "ascii": "".join("{} {} {} {} {}\n".format(*row) for row in ROWS).encode(),
}


def write(path: Path, data: str, old: str = "", new: str = "") -> Path:
    header = HEADER.format(data)
    assert old in header
    path.write_bytes(header.replace(old, new).encode() + DATA[data])
    return path


@pytest.mark.parametrize("data", DATA)
def test_points(tmp_path: Path, data: str) -> None:
    points = read_organized_points(write(tmp_path / "cloud.pcd", data))
    assert points.dtype == np.float64
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(
        read_organized_points(write(tmp_path / "cloud.pcd", data, "COUNT 1 1 1 1 1\n", "")), POINTS
    )


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


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("DATA", "DATE"),
        ("FIELDS x y z", "FIELDS x y w"),
        ("SIZE 4", "SIZE 3"),
        ("SIZE 4", "SIZE four"),
        ("TYPE F", "TYPE X"),
        ("TYPE F F F U U\n", ""),
        ("COUNT 1", "COUNT 2"),
        ("COUNT 1", "COUNT 0"),
        ("COUNT 1 1 1 1 1", "COUNT 1 1 1 1 9999999999999999999999"),
        ("WIDTH 3", "WIDTH 0"),
        ("WIDTH 3", "WIDTH"),
        ("HEIGHT 2", "HEIGHT 3"),
        ("HEIGHT 2\n", ""),
    ],
)
@pytest.mark.parametrize("data", DATA)
def test_damaged_headers(tmp_path: Path, data: str, old: str, new: str) -> None:
    path = write(tmp_path / "cloud.pcd", data, old, new)
    with input_error(path):
        read_organized_points(path)


@pytest.mark.parametrize(
    ("data", "old", "new", "expected"),
    [
        ("binary", b"DATA binary", b"DATA binary_compressed", "DATA binary_compressed"),
        ("binary", b"\x05\0\0\0", b"\x05\0\0", "is cut off"),
        ("ascii", b" 5\n", b"\n", "6 lines of 5 numbers"),
        ("ascii", b"2.5 ", b"x ", "6 lines of 5 numbers"),
        ("ascii", b"2.5 ", b"1 2 ", "6 lines of 5 numbers"),
    ],
)
def test_damaged_data(tmp_path: Path, data: str, old: bytes, new: bytes, expected: str) -> None:
    path = write(tmp_path / "cloud.pcd", data)
    assert path.read_bytes().count(old) == 1
    path.write_bytes(path.read_bytes().replace(old, new))
    with input_error(path, expected):
        read_organized_points(path)
