"""Bags that are written: detections of a recording, for ROS 2, RViz and Foxglove (extra `bags`).

with DetectionBag(Path("answers.mcap")) as bag:
    bag.write(frame, detections, stamp=stamp, frame_id="camera_color_optical_frame")
"""

import contextlib
import io
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np

from thor2_jax.errors import InputError, needs_extra
from thor2_jax.files import errors_name, temporary_directory
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.overlay import annotate
from thor2_jax.model.recognition import Detection
from thor2_jax.recordings.messages import detection_array, ros_time

__all__ = [
    "COMPRESSED_IMAGE",
    "DETECTIONS_TOPIC",
    "DETECTION_ARRAY",
    "OVERLAY_TOPIC",
    "VISION_MSGS",
    "DetectionBag",
    "MessageBag",
    "detection_types",
    "ros_message",
]

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

    It appears when the context ends, also with an exception, if at least one message was written.
    """

    argument = "path"

    def __init__(self, path: Path, topics: Mapping[str, str]) -> None:
        """Check that `path` can be written.

        Args:
            path: the MCAP file (.mcap), or the directory of the ROS 2 bag; it does not exist.
            topics: topic -> kind of its messages.

        Raises:
            InputError: it exists or names a ROS 1 bag, or the package rosbags is missing.
            OSError: its folder does not exist or cannot be written.
        """
        if path.suffix == ".bag":
            raise InputError(
                f"{self.argument} is {path}; expected an MCAP file (.mcap) or a directory for a ROS 2 bag: detections "
                "of ROS 1 have no names"
            )
        if path.exists() or path.is_symlink():
            raise InputError(f"{self.argument} is {path}, which exists; choose another name")
        with errors_name(path), tempfile.TemporaryFile(dir=path.absolute().parent):
            pass
        with needs_extra(f"{self.argument} is {path}, which", "rosbags", "bags"):
            self._types = detection_types()
        self._path, self._topics, self._n_messages = path, topics, 0

    def __enter__(self) -> Self:
        """Create a temporary bag beside `path`."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._stack = contextlib.ExitStack()
        folder = self._stack.enter_context(temporary_directory(self._path.absolute().parent))
        plugin = StoragePlugin.MCAP if self._path.suffix == ".mcap" else StoragePlugin.SQLITE3
        # ROS 2 names the files of a bag by its directory.
        self._bag = folder / self._path.stem
        self._writer = Writer(self._bag, version=8, storage_plugin=plugin)
        self._writer.open()
        self._connections = {
            topic: self._writer.add_connection(topic, kind, typestore=self._types)
            for topic, kind in self._topics.items()
        }
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bag and move it to `path`, or remove it if it is empty."""
        with self._stack, errors_name(self._path):
            self._writer.close()
            if self._n_messages:
                is_file = self._path.suffix == ".mcap"
                os.replace(next(self._bag.glob("*.mcap")) if is_file else self._bag, self._path)

    def write_message(self, topic: str, fields: Mapping[str, Any], stamp: int) -> None:
        """Write a message, recorded at `stamp` (ns) or, as bags have no earlier time, at 0.

        Raises:
            InputError: the time is out of the range of ROS 2.
        """
        if not -(2**31) <= stamp // 10**9 < 2**31:
            raise InputError(
                f"{self.argument}: a frame has the time {stamp // 10**9} s; expected {-(2**31)} to {2**31 - 1} s, the "
                f"range of ROS 2; correct the clock of the recording, or leave out {self.argument}"
            )
        kind = self._topics[topic]
        content = self._types.serialize_cdr(ros_message(fields), kind)
        with errors_name(self._path):
            self._writer.write(self._connections[topic], max(stamp, 0), content)
        self._n_messages += 1


class DetectionBag(MessageBag):
    """A bag with the detections of a recording.

    It holds `vision_msgs/Detection2DArray` in the topic `/thor2/detections` and, as JPEG, the colour images with
    outlines and names in `/thor2/overlay/compressed`.
    """

    argument = "out_bag"

    def __init__(self, path: Path) -> None:
        """Check that `path` can be written; exceptions as `MessageBag`."""
        super().__init__(path, {DETECTIONS_TOPIC: DETECTION_ARRAY, OVERLAY_TOPIC: COMPRESSED_IMAGE})

    def write(self, frame: RGBDFrame, detections: Sequence[Detection], *, stamp: int, frame_id: str = "") -> None:
        """Write the detections of a frame; arguments as `detection_array`, exceptions as `write_message`."""
        array = detection_array(detections, stamp=stamp, frame_id=frame_id)
        self.write_message(DETECTIONS_TOPIC, array, stamp)
        picture = io.BytesIO()
        annotate(frame.color, frame.label_image, [one.recognition for one in detections]).save(
            picture, "JPEG", quality=_JPEG_QUALITY
        )
        overlay = {
            "header": {"stamp": ros_time(stamp), "frame_id": frame_id},
            "format": "rgb8; jpeg compressed bgr8",
            "data": np.frombuffer(picture.getvalue(), np.uint8),
        }
        self.write_message(OVERLAY_TOPIC, overlay, stamp)


def ros_message(value: Any) -> Any:
    """Return what rosbags writes as a message: objects in place of mappings, and arrays of numbers."""
    if isinstance(value, Mapping):
        return SimpleNamespace(**{name: ros_message(field) for name, field in value.items()})
    if not isinstance(value, list):
        return value
    is_sequence = not value or isinstance(value[0], Mapping)
    return [ros_message(each) for each in value] if is_sequence else np.array(value, np.float64)
