"""Recordings that are not trusted: compressed parts of which ten kilobytes stand for gigabytes, truncated MCAP files.

An MCAP file is a sequence of records: a byte for the kind, the length in eight bytes, and the content. Its last record,
the footer, says where the index lies; without an index, readers scan the records.
"""

import bz2
import functools
import io
import itertools
import os
from collections.abc import Callable, Collection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

from thor2_jax.files import open_file

__all__ = [
    "CompleteRecords",
    "MAX_DECOMPRESSED",
    "MAX_OVERLAPPING",
    "is_truncated",
    "largest_overlap",
    "limit_decompression",
]

MAX_DECOMPRESSED = 2**28
"""Largest size in bytes of a decompressed chunk or message, that of an image of `MAX_IMAGE_PIXELS` in four channels."""

MAX_OVERLAPPING = 2**29
"""Largest size in bytes of the decompressed chunks of an MCAP file that overlap in time."""

MAX_RATIO = 1000
"""Largest ratio of decompressed to compressed size of files that decompress to more than `MAX_DECOMPRESSED`."""


@functools.cache
def limit_decompression() -> None:
    """Let rosbags, which decompresses without a limit, raise ValueError beyond `MAX_DECOMPRESSED`, in this process."""
    import apsw
    import lz4.frame
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader, storage_mcap

    rosbag2: Any = reader
    lz4_frame, zstd = _limited(lz4.frame.LZ4FrameDecompressor), _limited(rosbag2.zstd.ZstdDecompressor)
    rosbag1.decompressors.update(bz2=_limited(bz2.BZ2Decompressor), lz4=lz4_frame)
    storage_mcap.DECOMPRESSORS.update(lz4=lz4_frame, zstd=zstd)
    rosbag2.zstd = SimpleNamespace(decompress=zstd, open=functools.partial(_open_limited, rosbag2.zstd.open))
    # A column of a database can be computed, and be larger than the file.
    hooks: list[Any] = apsw.connection_hooks
    hooks.append(lambda database: database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_DECOMPRESSED))


def _limited(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a function that decompresses with the standard library's interface of incremental decompressors."""

    def decompress(data: bytes, *_: object) -> bytes:
        stream = decompressor()
        content = bytes(stream.decompress(data, MAX_DECOMPRESSED))
        if not stream.eof or stream.unused_data:
            raise ValueError(
                f"compressed data is truncated, in several parts, or of more than {MAX_DECOMPRESSED} bytes"
            )
        return content

    return decompress


def _open_limited(open_file: Callable[..., Any], stream: Any, mode: str) -> Any:
    """Open a bag that is compressed as a whole file; reading raises ValueError beyond `MAX_RATIO` times its size."""
    file = open_file(stream, mode)
    limit, read = max(MAX_DECOMPRESSED, MAX_RATIO * os.fstat(stream.fileno()).st_size), file.read

    def read_limited(size: int) -> bytes:
        if file.tell() > limit:
            raise ValueError(f"a compressed file has more than {limit} bytes")
        return bytes(read(size))

    file.read = read_limited
    return file


def largest_overlap(reader: Any, channels: Collection[int]) -> int:
    """Return the largest size in bytes of the chunks of an MCAP file that overlap in time: rosbags holds them together.

    Args:
        reader: reader of rosbags.
        channels: numbers of the connections that are read; chunks without them do not count.
    """
    storage = getattr(reader, "storage", None)
    largest = 0
    for each in getattr(storage, "storages", [storage]):
        edges = []
        for chunk in getattr(each, "chunks", ()):
            if any(chunk.channel_count.get(channel) for channel in channels):
                start, size = chunk.message_start_time, chunk.uncompressed_size
                edges += [(start, 0, size), (max(start, chunk.message_end_time), 1, -size)]
        largest = max([largest, *itertools.accumulate(size for *_, size in sorted(edges))])
    return largest


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
