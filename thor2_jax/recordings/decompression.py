"""A limit on what the compressed parts of a recording decompress to: ten kilobytes can stand for gigabytes."""

import bz2
import functools
import itertools
import os
from collections.abc import Callable, Collection
from types import SimpleNamespace
from typing import Any

__all__ = ["MAX_DECOMPRESSED", "MAX_OVERLAPPING", "largest_overlap", "limit_decompression"]

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
