"""Organized point clouds in PCD files (Point Cloud Library), ascii and binary."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError

__all__ = ["read_organized_points"]

_KINDS = {"F": "f", "I": "i", "U": "u"}


def read_organized_points(path: str | Path) -> NDArray[np.float64]:
    """Read the points [HEIGHT, WIDTH, 3] of a PCD file in the file's unit (usually metres), NaN where it has none.

    Fields other than x, y and z are ignored.

    Raises:
        InputError: the file is damaged, compressed or without x, y and z; the message names it.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    content = path.read_bytes()
    header, start = _header(content, path)
    try:
        fields = header["FIELDS"]
        counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
        types = [f"<{_KINDS[kind]}{int(size)}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
        record = np.dtype([(f"{i}", t, (n,)) for i, (_, t, n) in enumerate(zip(fields, types, counts, strict=True))])
        axes = [fields.index(name) for name in "xyz"]
        width, height = int(header["WIDTH"][0]), int(header["HEIGHT"][0])
        (encoding,) = header["DATA"]
    except (KeyError, IndexError, ValueError, TypeError, OverflowError):
        raise InputError(f"{path}: its header does not describe points with x, y and z") from None
    if min(width, height) < 1 or any(counts[axis] != 1 for axis in axes):
        raise InputError(
            f"{path}: its header has {width} x {height} points with fields of {counts} numbers; "
            "expected at least one point and one number for each axis"
        )
    if encoding == "binary":
        points = _binary(content[start:], record, width * height, axes, path)
    elif encoding == "ascii":
        points = _ascii(content[start:], counts, width * height, axes, path)
    else:
        raise InputError(f"{path} has DATA {encoding}; expected ascii or binary")
    return points.reshape(height, width, 3)


def _header(content: bytes, path: Path) -> tuple[dict[str, list[str]], int]:
    """Return the lines of the header (first word -> other words) and the offset of the data."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = content.find(b"\n", start)
        if end < 0:
            raise InputError(f"{path} is not a PCD file; expected a line DATA")
        words = content[start:end].decode("ascii", errors="replace").split()
        if words:
            header[words[0]] = words[1:]
        start = end + 1
    return header, start


def _binary(data: bytes, record: np.dtype[Any], n: int, axes: list[int], path: Path) -> NDArray[np.float64]:
    if len(data) < n * record.itemsize:
        raise InputError(f"{path} is cut off: {len(data)} bytes of data; {n * record.itemsize} expected")
    records = np.frombuffer(data, record, count=n)
    return np.stack([records[f"{axis}"][:, 0].astype(np.float64) for axis in axes], axis=-1)


def _ascii(data: bytes, counts: list[int], n: int, axes: list[int], path: Path) -> NDArray[np.float64]:
    try:
        numbers = np.array(data.split(), np.float64).reshape(n, sum(counts))
    except (ValueError, OverflowError):
        raise InputError(f"{path} does not hold {n} lines of {sum(counts)} numbers") from None
    return numbers[:, [sum(counts[:axis]) for axis in axes]]
