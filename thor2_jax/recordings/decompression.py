"""A limit on what the compressed parts of a recording decompress to: ten kilobytes can stand for gigabytes."""

import bz2
import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

__all__ = ["MAX_DECOMPRESSED", "limit_decompression"]

MAX_DECOMPRESSED = 2**28
"""Largest size in bytes of a decompressed chunk or message, that of an image of `MAX_IMAGE_PIXELS` in four channels."""


@functools.cache
def limit_decompression() -> None:
    """Let rosbags, which decompresses without a limit, raise ValueError beyond `MAX_DECOMPRESSED`, in this process."""
    import lz4.frame
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader, storage_mcap

    rosbag2: Any = reader
    lz4_frame, zstd = _limited(lz4.frame.LZ4FrameDecompressor), _limited(rosbag2.zstd.ZstdDecompressor)
    rosbag1.decompressors.update(bz2=_limited(bz2.BZ2Decompressor), lz4=lz4_frame)
    storage_mcap.DECOMPRESSORS.update(lz4=lz4_frame, zstd=zstd)
    rosbag2.zstd = SimpleNamespace(decompress=zstd, open=rosbag2.zstd.open)


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
