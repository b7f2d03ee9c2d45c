"""Frames from ROS 1, ROS 2 and MCAP recordings: pairs of colour and depth images nearest in time (extra `bags`).

    with Bag("table.mcap") as bag:
        for recorded in bag.frames():
            frame = segmented(recorded.read())

Recordings are not trusted: ten kilobytes of their compressed parts can decompress to gigabytes. The end of an MCAP file
may be missing. Such a file is a sequence of records: a byte for the kind, the length in eight bytes, and the content.
Its last record, the footer, contains the position of the index; without an index, readers scan the records.
"""

import bz2
import contextlib
import functools
import io
import itertools
import os
import shlex
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from thor2_jax.errors import InputError, needs_extra, reason_of, with_context
from thor2_jax.files import as_path, open_file, parse_yaml, read_file
from thor2_jax.frames.frames import RecordedFrame, RGBDFrame
from thor2_jax.frames.intrinsics import Intrinsics
from thor2_jax.recordings.messages import camera_of, color_image, depth_image, image_kind, stamp_name, stamp_of
from thor2_jax.recordings.topics import DEFAULT_MAX_GAP, PairCounts, StampedImage, Topics, choose_topics, nearest_pairs

__all__ = ["Bag"]

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"

MAX_GAP = 1e9
"""Largest `max_gap`, seconds."""

_REPAIR = {".bag": "rosbag reindex {}", ".mcap": "mcap recover {} -o recovered.mcap", ".db3": "ros2 bag reindex {}"}
"""Suffix of a file -> command that repairs it; for directories, the command of .db3."""

MAX_DECOMPRESSED = 2**28
"""Largest size in bytes of a decompressed chunk or message: an image of `MAX_IMAGE_PIXELS` with four channels."""

MAX_OVERLAPPING = 2**29
"""Largest size in bytes of the decompressed chunks of an MCAP file that overlap in time."""

MAX_RATIO = 1000
"""Largest ratio of decompressed to compressed size of files that decompress to more than `MAX_DECOMPRESSED`."""


class Bag:
    """A recording that is open inside its context.

    Attributes:
        path: the file, or the directory of a ROS 2 bag.
        topics: the topics that are read.
        frame_id: coordinate frame of the colour images.
        counts: numbers of images and pairs so far.
        is_truncated: whether the end of the recording is missing; complete frames of an MCAP file are read anyway.
        intrinsics: intrinsics of the colour camera.
        notes: warnings about likely mistakes in the recording.
    """

    def __init__(
        self,
        path: str | Path,
        topics: Topics | None = None,
        *,
        intrinsics: Intrinsics | None = None,
        depth_scale: float | None = None,
        max_gap: float = DEFAULT_MAX_GAP,
    ) -> None:
        """Set the arguments; `__enter__` opens the recording.

        Args:
            path: a ROS 1 bag (.bag), a ROS 2 bag (its directory, or a .db3 file) or an MCAP file.
            topics: names of topics; by default they are chosen by their content.
            intrinsics: intrinsics of the colour camera, in place of the recorded ones.
            depth_scale: depth units per metre, in place of the 1000 of ROS.
            max_gap: largest time between the two images of a frame, seconds.

        Raises:
            InputError: `max_gap` is not a positive number, or too large.
        """
        if not 0 < max_gap <= MAX_GAP:
            raise InputError(f"max_gap is {max_gap}; expected a positive number of seconds, at most {MAX_GAP:g}")
        self.path = as_path(path, "bag")
        self.intrinsics: Intrinsics | None = intrinsics
        self._wanted, self._depth_scale, self._max_gap = topics or Topics(), depth_scale, max_gap
        self.topics, self.frame_id, self.counts = Topics(), "", PairCounts()
        self.is_truncated = False
        self.notes: list[str] = []
        self._reader: Any = None

    def __enter__(self) -> "Bag":
        """Open the recording, choose its topics and read the camera.

        Raises:
            InputError: the package rosbags is missing, the recording is damaged or of another format, it lacks a topic,
                or a part of its messages is in a write-ahead log.
            OSError: the recording cannot be opened.
        """
        with needs_extra(f"bag is {self.path}, which", "rosbags", "bags"):
            from rosbags.rosbag1 import Reader as Reader1
            from rosbags.rosbag2 import Reader as Reader2
            from rosbags.typesys import Stores, get_typestore

            _adapt_rosbags()
        for file in [self.path, *self.path.glob("*")]:
            if not file.is_dir():
                open_file(file).close()  # raises OSError for a pipe, which rosbags would read forever
        for log in [Path(f"{self.path}-wal"), *self.path.glob("*-wal")]:  # rosbags would ignore it
            if log.is_file() and log.stat().st_size:
                raise InputError(
                    f"bag: {self.path}: messages of an interrupted recording are in {log.name}; expected them in the "
                    f"database; repair it: sqlite3 {shlex.quote(str(log)[:-4])} 'PRAGMA wal_checkpoint(TRUNCATE)'"
                )
        # The directory of a ROS 2 bag may have any name, such as run.bag.
        self._suffix = ".db3" if self.path.is_dir() else self.path.suffix
        with self._damage_named():
            if self.path.is_dir():
                if not (self.path / "metadata.yaml").is_file():
                    raise ValueError("it has no metadata.yaml")
                # rosbags would expand YAML aliases without a limit, and could not close invalid values of "files".
                files = parse_yaml(read_file(self.path / "metadata.yaml"))["rosbag2_bagfile_information"].get("files")
                if not isinstance(files, list | None):
                    raise ValueError("files of metadata.yaml is not a list")
            self.is_truncated = self._suffix == ".mcap" and _is_truncated(self.path)
            # ROS's image definitions are used, which have not changed; rosbags would compile those of the file.
            if self._suffix == ".bag":
                self._reader = Reader1(self.path)
                self._deserialize = get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
            else:
                self._reader = Reader2(self.path)
                if self.is_truncated:
                    self._reader.storage.path = SimpleNamespace(open=lambda _: _CompleteRecords(io.FileIO(self.path)))
                self._deserialize = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
            with contextlib.ExitStack() as stack:
                stack.enter_context(self._reader)
                self._choose()
                self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the recording."""
        self._opened.close()
        self._reader = None

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield the frames in the order of their time stamps.

        Raises:
            InputError: the rest of the recording is damaged or missing, or no two images are near enough in time.
        """
        tolerance = round(self._max_gap * 1e9)
        names: Counter[str] = Counter()
        images = (
            StampedImage(topic == self.topics.color, stamp_of(message) or arrival, arrival, message)
            for topic, message, arrival in self._messages(self.topics.color, self.topics.depth)
        )
        for color, depth in nearest_pairs(images, tolerance, self.counts):
            read, name = functools.partial(self._read, color.message, depth.message), stamp_name(color.stamp)
            names[name] += 1
            unique = name if names[name] == 1 else f"{name}-{names[name]}"
            yield RecordedFrame(unique, read, color.stamp, depth.stamp - color.stamp, self.frame_id)
        if self.is_truncated:
            raise self._truncation()
        if self.counts.pairs == 0:
            smallest = self.counts.smallest_gap
            apart = "" if smallest is None else f", at least {smallest / 1e9:.3g} s apart"
            raise InputError(
                f"bag: {self.path}: {self.counts.color} images of {self.topics.color} and {self.counts.depth} of "
                f"{self.topics.depth}{apart}; expected at most {self._max_gap:g} s; check the clocks of the streams, "
                "or raise max_gap"
            )

    def _repair(self, suffix: str) -> str:
        return _REPAIR[suffix].format(shlex.quote(str(self.path)))

    def _truncation(self) -> InputError:
        return InputError(
            f"bag: {self.path} is truncated after {self.counts.color} colour images: its end is missing; "
            f"repair it: {self._repair('.mcap')}, or record it again"
        )

    def _read(self, color_message: Any, depth_message: Any) -> RGBDFrame:
        color, depth = color_image(color_message), depth_image(depth_message)
        if color.shape[:2] != depth.shape:
            raise InputError(
                f"depth has {depth.shape[1]} x {depth.shape[0]} pixels and color {color.shape[1]} x {color.shape[0]}; "
                f"expected depth that is aligned to color; {self.topics.depth} is not: record or choose the aligned one"
            )
        assert self.intrinsics is not None
        return RGBDFrame(color, depth, None, self.intrinsics)

    def _messages(self, *topics: str | None) -> Iterator[tuple[str, Any, int]]:
        """Yield the messages of some topics: topic, message, and time of arrival in nanoseconds."""
        if self._reader is None:
            raise InputError(f"bag: {self.path} is not open; read its frames inside a with statement")
        connections = [each for each in self._reader.connections if each.topic in topics]
        with self._damage_named():
            for connection, arrival, content in self._reader.messages(connections):
                yield connection.topic, self._deserialize(content, connection.msgtype), int(arrival)

    def _choose(self) -> None:
        """Choose the topics by their first messages, and read the camera."""
        types = {connection.topic: connection.msgtype for connection in self._reader.connections}
        images = [topic for topic, kind in types.items() if kind in (*IMAGE_TYPES, CAMERA_TYPE)]
        overlap = _largest_overlap(self._reader, {c.id for c in self._reader.connections if c.topic in images})
        if overlap > MAX_OVERLAPPING:
            raise InputError(
                f"bag: {self.path} has {overlap} bytes of images in chunks of the same time; expected at most "
                f"{MAX_OVERLAPPING}; record it with smaller chunks"
            )
        first = {topic: message for topic in images for _, message, _ in itertools.islice(self._messages(topic), 1)}
        if self.is_truncated and not first:
            raise self._truncation()
        kinds = {t: "camera" if types[t] == CAMERA_TYPE else image_kind(message) for t, message in first.items()}
        types |= {t: f"{types[t]} without messages" for t in images if t not in first}
        types |= {t: f"{types[t]}, {m.encoding!r}" for t, m in first.items() if hasattr(m, "encoding")}
        with with_context(f"bag: {self.path}"):
            self.topics = choose_topics(self._wanted, kinds, types, needs_camera=self.intrinsics is None)
            if self.intrinsics is None:
                with with_context(str(self.topics.camera)):
                    self.intrinsics = camera_of(first[self.topics.camera], str(self.topics.color))
        self.intrinsics = self.intrinsics.with_depth_scale(self._depth_scale)
        self.frame_id = str(first[self.topics.color].header.frame_id)
        likely = {self.topics.depth: "not aligned to color", self.topics.camera: "the camera of other images"}
        for topic, mistake in likely.items():
            if topic and (its := first[topic].header.frame_id) != self.frame_id:
                self.notes.append(f"{topic} is in coordinate frame {its}, color in {self.frame_id}: probably {mistake}")

    @contextlib.contextmanager
    def _damage_named(self) -> Iterator[None]:
        """Turn any exception of rosbags and its decompressors for a damaged file into an InputError."""
        try:
            yield
        except (OSError, InputError):
            raise
        except Exception as error:
            after = f" after {self.counts.color} colour images" if self.counts.color else ""
            raise InputError(
                f"bag: {self.path} is damaged or of another format{after} ({reason_of(error).rstrip('.')}); expected a "
                "ROS 1 bag (.bag), a ROS 2 bag (directory, .db3) or MCAP of ROS 2"
                + (f"; repair it: {self._repair(self._suffix)}" if self._suffix in _REPAIR else "")
            ) from None


@functools.cache
def _adapt_rosbags() -> None:
    """Make rosbags raise ValueError beyond `MAX_DECOMPRESSED` bytes in this process; by itself it has no limit.

    MCAP files without an index, also of the messages in their chunks, are read in the order in which they were written:
    by itself, rosbags refuses such messages if they are not in the order of time, and finds none in such chunks.
    """
    import apsw
    import lz4.frame
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader, storage_mcap

    rosbag2: Any = reader
    lz4_frame, zstd = _limited(lz4.frame.LZ4FrameDecompressor), _limited(rosbag2.zstd.ZstdDecompressor)
    rosbag1.decompressors.update(bz2=_limited(bz2.BZ2Decompressor), lz4=lz4_frame)
    storage_mcap.DECOMPRESSORS.update(lz4=lz4_frame, zstd=zstd)
    mcap: Any = storage_mcap.McapReader
    indexed, scan = mcap.messages, mcap.messages_scan
    mcap.messages = lambda file, *args: (indexed if any(c.channel_count for c in file.chunks) else scan)(file, *args)
    rosbag2.zstd = SimpleNamespace(decompress=zstd, open=functools.partial(_open_limited, rosbag2.zstd.open))
    # A computed column of a database can be larger than the file.
    hooks: list[Any] = apsw.connection_hooks
    hooks.append(lambda database: database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_DECOMPRESSED))


def _limited(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
    """Return a limited decompression function for an incremental decompressor (interface of the standard library)."""

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


def _largest_overlap(reader: Any, channels: Collection[int]) -> int:
    """Return the largest total size in bytes of chunks that overlap in time; rosbags keeps them in memory together.

    Args:
        reader: reader of rosbags.
        channels: numbers of the connections that are read; chunks without these are ignored.
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


def _is_truncated(path: Path) -> bool:
    """Return whether a file has the beginning, but not the end, of an MCAP file; raise OSError on failure."""
    with open_file(path) as stream:
        if stream.read(len(_MAGIC)) != _MAGIC:
            return False
        stream.seek(-len(_MAGIC), os.SEEK_END)
        return stream.read() != _MAGIC or stream.tell() == len(_MAGIC)


class _CompleteRecords(io.BufferedReader):
    """The complete records of a truncated MCAP file, followed by the end of a file without an index.

    The end, `_TAIL`, is the only thing that rosbags reads without a size.
    """

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
        """Move to a position and return it; the end is the end of the complete records, where `_TAIL` follows."""
        return super().seek(self._end) if whence == os.SEEK_END else super().seek(offset, whence)

    def read(self, size: int | None = -1) -> bytes:
        """Return the next bytes, or `_TAIL`."""
        return _TAIL if size == -1 else super().read(size)
