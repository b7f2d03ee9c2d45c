"""Files with the detections of frames: bags for ROS 2, RViz and Foxglove (extra `bags`), and for Rerun (extra `rerun`).

with DetectionBag(Path("answers.mcap")) as bag, RerunFile(Path("answers.rrd")) as file:
    bag.write(frame, detections, stamp=stamp, frame_id="camera_color_optical_frame")
    file.write(frame, detections, name="000001")
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from thor2_jax.errors import InputError, needs_extra
from thor2_jax.files import as_path, check_output_file, check_writable, errors_name, new_directory, temporary_directory
from thor2_jax.frames.frames import RGBDFrame, encode_image
from thor2_jax.frames.overlay import annotate, answer_paints
from thor2_jax.model.recognition import Detection
from thor2_jax.printable import escape_characters
from thor2_jax.recordings.messages import detection_array, ros_time

__all__ = ["COMPRESSED_IMAGE", "DetectionBag", "MessageBag", "RerunFile"]

DETECTIONS_TOPIC = "/thor2/detections"
OVERLAY_TOPIC = "/thor2/overlay/compressed"

DETECTION_ARRAY = "vision_msgs/msg/Detection2DArray"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"

VISION_MSGS = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": ("vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"),
    "Detection2D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox2D bbox\n"
        "string id"
    ),
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
}
"""Definitions of the messages of vision_msgs 4 (ROS 2 Humble and later) that rosbags does not ship."""

_JPEG_QUALITY = 85


@contextlib.contextmanager
def _file_errors(path: Path) -> Iterator[None]:
    """Turn errors of files, of the database of a bag and of Rerun's writer into an OSError that names `path`."""
    import sqlite3

    with errors_name(path):
        try:
            yield
        except (sqlite3.Error, RuntimeError) as error:
            raise OSError(None, f"{error}; check the free space of the disk") from None


def detection_types() -> Any:
    """Return a typestore of rosbags for ROS 2 Humble with the messages of `VISION_MSGS`.

    Raises:
        ImportError: rosbags is not installed.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    typestore = get_typestore(Stores.ROS2_HUMBLE)
    for name, definition in VISION_MSGS.items():
        typestore.register(get_types_from_msg(definition, f"vision_msgs/msg/{name}"))
    return typestore


class MessageBag:
    """A ROS 2 bag or an MCAP file that is being written.

    The bag appears when the context ends, even by an exception of something else, if at least one message was written.
    """

    argument = "path"

    def __init__(self, path: str | Path, topics: Mapping[str, str]) -> None:
        """Check that `path` can be written.

        Args:
            path: the new MCAP file (.mcap), or the new directory of the ROS 2 bag.
            topics: topic -> type of its messages.

        Raises:
            InputError: `path` exists, names a ROS 1 bag or cannot be written, or the package rosbags is missing.
        """
        path = as_path(path, self.argument)
        if path.suffix == ".bag":
            raise InputError(
                f"{self.argument} is {path}; expected an MCAP file (.mcap) or a directory for a ROS 2 bag: detections "
                "of ROS 1 have no names"
            )
        if path.exists() or path.is_symlink():
            raise InputError(f"{self.argument} is {path}, which exists; choose another name")
        check_output_file(self.argument, path, Path.is_file)
        with needs_extra(f"{self.argument} is {path}, which", "rosbags", "bags"):
            self._types = detection_types()
        self._path, self._topics, self._n_messages = path, topics, 0

    def __enter__(self) -> Self:
        """Create a temporary bag beside `path`."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if self._path.suffix == ".mcap" else StoragePlugin.SQLITE3
        with _file_errors(self._path), contextlib.ExitStack() as stack:
            stack.enter_context(new_directory(parent := self._path.absolute().parent))
            folder = stack.enter_context(temporary_directory(parent))
            # ROS 2 names the files of a bag after its directory.
            self._bag = folder / self._path.stem
            self._writer = Writer(self._bag, version=8, storage_plugin=plugin)
            stack.callback(self._writer.abort)  # closes what an error leaves open
            self._writer.open()
            self._connections = {
                topic: self._writer.add_connection(topic, kind, typestore=self._types)
                for topic, kind in self._topics.items()
            }
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        """Close the bag and move it to `path`, or remove it if it is empty."""
        with _file_errors(self._path), self._stack:
            self._writer.close()
            # After an error of its own, such as a full disk, a database has lost all messages.
            if self._n_messages and getattr(error, "filename", None) != str(self._path):
                written = next(self._bag.glob("*.mcap")) if self._path.suffix == ".mcap" else self._bag
                written.replace(self._path)

    def write_message(self, topic: str, fields: Mapping[str, Any], stamp: int) -> None:
        """Write a message with the recording time `stamp` (ns), or 0 if it is negative.

        Raises:
            InputError: the time is outside the range of ROS 2.
        """
        if not -(2**31) <= stamp // 10**9 < 2**31:
            raise InputError(
                f"{self.argument}: a frame has the time {stamp // 10**9} s; expected {-(2**31)} to {2**31 - 1} s, the "
                f"range of ROS 2; correct the clock of the recording, or leave out {self.argument}"
            )
        content = self._types.serialize_cdr(ros_message(fields), self._topics[topic])
        with _file_errors(self._path):
            self._writer.write(self._connections[topic], max(stamp, 0), content)
        self._n_messages += 1


class DetectionBag(MessageBag):
    """A bag with the detections of a recording.

    The topic `/thor2/detections` has `vision_msgs/Detection2DArray`; `/thor2/overlay/compressed` has the colour images
    with outlines and names as JPEG.
    """

    argument = "out_bag"

    def __init__(self, path: str | Path) -> None:
        """Check that `path` can be written; exceptions as `MessageBag`."""
        super().__init__(path, {DETECTIONS_TOPIC: DETECTION_ARRAY, OVERLAY_TOPIC: COMPRESSED_IMAGE})

    def write(self, frame: RGBDFrame, detections: Sequence[Detection], *, stamp: int, frame_id: str = "") -> None:
        """Write the detections of a frame; arguments as `detection_array`, exceptions as `write_message`."""
        array = detection_array(detections, stamp=stamp, frame_id=frame_id)
        self.write_message(DETECTIONS_TOPIC, array, stamp)
        picture = annotate(frame, [one.recognition for one in detections])
        overlay = {
            "header": {"stamp": ros_time(stamp), "frame_id": frame_id},
            "format": "rgb8; jpeg compressed bgr8",
            "data": np.frombuffer(encode_image(picture, "JPEG", quality=_JPEG_QUALITY), np.uint8),
        }
        self.write_message(OVERLAY_TOPIC, overlay, stamp)


def ros_message(value: Any) -> Any:
    """Return a message in the form that rosbags writes: objects instead of mappings, and arrays of numbers."""
    if isinstance(value, Mapping):
        return SimpleNamespace(**{name: ros_message(field) for name, field in value.items()})
    if not isinstance(value, list):
        return value
    is_sequence = not value or isinstance(value[0], Mapping)
    return [ros_message(each) for each in value] if is_sequence else np.array(value, np.float64)


_APPLICATION = "thor2"

_MAX_CLASS = 2**16 - 1
"""Largest label number of a segmentation image of Rerun."""


class RerunFile:
    """An .rrd file that is being written.

    The entity `camera` has the colour and depth images, the labels and the boxes of the instances; `objects` has the
    positions of the objects. If at least one frame was written, the file appears when the context ends, even by an
    exception, and replaces an older one.

    Attributes:
        path: the file.
        n_frames: number of frames written.
    """

    def __init__(self, path: str | Path) -> None:
        """Check that `path` can be written.

        Raises:
            InputError: the suffix is not .rrd, the file is a recording of another program or cannot be written, or
                rerun-sdk is missing or disabled.
        """
        path = as_path(path, "rerun")
        if path.suffix != ".rrd" or path.is_dir():
            raise InputError(f"rerun is {path}; expected a file with the suffix .rrd")
        check_output_file("rerun", path, _is_own)  # Rerun would wait forever on a full disk.
        with needs_extra(f"rerun is {path}, which", "rerun-sdk", "rerun"):
            import rerun
        self._rerun: Any = rerun
        self._recording = rerun.RecordingStream(_APPLICATION)
        if not rerun.is_enabled(self._recording):
            raise InputError(f"rerun is {path}, but the variable RERUN disables Rerun; unset it")
        self.path, self.n_frames, self._folder = path, 0, contextlib.ExitStack()

    def __enter__(self) -> "RerunFile":
        """Create a temporary file beside `path`."""
        parent = self.path.absolute().parent
        with errors_name(self.path):
            self._folder.enter_context(new_directory(parent))
            self._temporary = self._folder.enter_context(temporary_directory(parent)) / self.path.name
        self._recording.save(self._temporary)
        # Camera coordinates are those of OpenCV: x right, y down, z forward.
        self._recording.log("/", self._rerun.ViewCoordinates.RDF, static=True)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file and move it to `path`, or remove it if it is empty."""
        with self._folder, _file_errors(self.path):
            self._recording.flush()
            self._recording.disconnect()
            check_writable(self._temporary.parent)  # On a full disk, Rerun leaves out the end without an error.
            if self.n_frames:
                self._temporary.chmod(0o644)
                self._temporary.replace(self.path)

    def write(self, frame: RGBDFrame, detections: Sequence[Detection], *, name: str, stamp: int | None = None) -> None:
        """Write a frame with labels and its detections.

        Lens distortion is not written, since Rerun's camera has none.

        Args:
            frame: the frame.
            detections: detections in the frame.
            name: name of the frame.
            stamp: time of the frame, nanoseconds; None if it is unknown.
        """
        rerun, log = self._rerun, self._recording.log
        self._recording.set_time("frame", sequence=self.n_frames)
        if stamp is not None:
            self._recording.set_time("time", timestamp=np.datetime64(stamp, "ns"))
        k = frame.intrinsics
        pinhole = rerun.Pinhole(
            focal_length=(k.fx, k.fy), principal_point=(k.cx, k.cy), resolution=frame.depth.shape[::-1]
        )
        log("camera", pinhole)
        log("camera/name", rerun.TextDocument(escape_characters(name)))
        log("camera/color", rerun.Image(frame.color).compress(jpeg_quality=_JPEG_QUALITY))
        log("camera/depth", rerun.DepthImage(frame.depth_m, meter=1.0))
        if frame.label_image.max() <= _MAX_CLASS:
            log("camera/labels", rerun.SegmentationImage(frame.label_image.astype(np.uint16)))
        labels = [_label(one) for one in detections]
        colors = answer_paints([one.recognition for one in detections])
        boxes = np.array([one.box for one in detections], np.float32).reshape(-1, 4)
        log("camera/boxes", rerun.Boxes2D(mins=boxes[:, :2], sizes=boxes[:, 2:], labels=labels, colors=colors))
        placed = [(one.position, i) for i, one in enumerate(detections) if one.position is not None]
        points = rerun.Points3D(
            np.array([position for position, _ in placed], np.float32).reshape(-1, 3),
            labels=[labels[i] for _, i in placed],
            colors=[colors[i] for _, i in placed],
            radii=0.01,
        )
        log("objects", points)
        self.n_frames += 1


def _is_own(path: Path) -> bool:
    """Return whether a file is a recording of this software, whose head contains the application's name."""
    with path.open("rb") as file:
        head = file.read(4096)
    return head.startswith(b"RRF") and _APPLICATION.encode() in head


def _label(detection: Detection) -> str:
    answer = detection.recognition
    confidence = "" if answer.confidence is None else f" {answer.confidence:.2f}"
    return f"{answer.name or 'unknown'}{confidence}"
