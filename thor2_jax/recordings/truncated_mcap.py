"""Truncated MCAP files: their complete records as a file that rosbags can read.

An MCAP file is a sequence of records: a byte for the kind, the length in eight bytes, and the content. Its last record,
the footer, says where the index lies; without an index, readers scan the records.
"""

import io
import os
from pathlib import Path
from typing import Any, BinaryIO

from thor2_jax.files import open_file

__all__ = ["CompleteRecords", "is_truncated"]

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _DATA_END = 0x02, 0x0F
_HEADER_BYTES = 9
_TAIL = bytes([_FOOTER]) + (20).to_bytes(8, "little") + bytes(20) + _MAGIC
"""Footer of a file without an index, and the end of every file."""


def is_truncated(path: Path) -> bool:
    """Return whether a file begins as MCAP and does not end so; raises OSError."""
    with open_file(path) as stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            return False
        stream.seek(-len(_MAGIC), os.SEEK_END)
        return stream.read() != _MAGIC or stream.tell() == len(_MAGIC)


class CompleteRecords(type(Path())):  # type: ignore[misc]  # Path itself cannot be derived from before Python 3.12
    """A path to a truncated MCAP file that opens as one with all its complete records, and without an index."""

    def open(self, mode: str = "rb") -> BinaryIO:
        """Open the complete records for reading."""
        stream = super().open(mode)
        return io.BufferedReader(_View(stream, _complete_bytes(stream)))


def _complete_bytes(stream: Any) -> int:
    """Return the number of bytes of the complete records before the index."""
    size = stream.seek(0, os.SEEK_END)
    position = len(_MAGIC)
    while True:
        stream.seek(position)
        header = stream.read(_HEADER_BYTES)
        if len(header) < _HEADER_BYTES or header[0] in (_DATA_END, _FOOTER):
            return position
        end = position + _HEADER_BYTES + int.from_bytes(header[1:], "little")
        if end > size:
            return position
        position = end


class _View(io.RawIOBase):
    """The first bytes of a file, and `_TAIL`."""

    def __init__(self, stream: Any, size: int) -> None:
        self._stream, self._size, self._position = stream, size, 0

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def seekable(self) -> bool:
        """Return that it is a file."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position, and return it."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size + len(_TAIL)}[whence]
        self._position = max(start + offset, 0)
        return self._position

    def readinto(self, buffer: Any) -> int:
        """Read the next bytes, and return their number."""
        count = len(buffer)
        if self._position < self._size:
            self._stream.seek(self._position)
            content = self._stream.read(min(count, self._size - self._position))
        else:
            content = _TAIL[self._position - self._size :][:count]
        buffer[: len(content)] = content
        self._position += len(content)
        return len(content)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()
        super().close()
