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
        return _OpenRecords(io.FileIO(self, mode))


class _OpenRecords(io.BufferedReader):
    """A truncated MCAP file, for rosbags: only `_TAIL` is read without a size, and it is looked for at the end."""

    def __init__(self, stream: io.FileIO) -> None:
        size = os.fstat(stream.fileno()).st_size
        self._end = end = len(_MAGIC)
        super().__init__(stream)
        while end <= size:
            self._end = end
            self.seek(end)
            header = self.read(_HEADER_BYTES)
            if len(header) < _HEADER_BYTES or header[0] in (_DATA_END, _FOOTER):
                break
            end += _HEADER_BYTES + int.from_bytes(header[1:], "little")
        self.seek(0)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position, for which `_TAIL` lies at the end of the complete records, and return it."""
        return super().seek(self._end) if whence == os.SEEK_END else super().seek(offset, whence)

    def read(self, size: int | None = -1) -> bytes:
        """Return the next bytes, or `_TAIL`."""
        return _TAIL if size == -1 else super().read(size)
