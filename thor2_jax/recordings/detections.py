"""Detections: the answers for a frame with the positions of the objects, as JSON and as vision_msgs/Detection2DArray.

detections = detections_of(frame, recognizer.recognize(frame))
detection_array(detections, stamp=stamp, frame_id="camera_color_optical_frame")   # fields of the ROS message
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

from thor2_jax.frames.frames import RGBDFrame, pixel_rays
from thor2_jax.model.recognition import Recognition

__all__ = ["Box", "Detection", "detection_array", "detections_as_json", "detections_of", "ros_time"]


class Box(NamedTuple):
    """The smallest rectangle of whole pixels around an instance."""

    left: int
    top: int
    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class Detection:
    """The answer for an instance, and where it is.

    Attributes:
        recognition: the answer.
        box: its place in the image, pixels.
        position: mean of its visible points in the OpenCV camera frame (x right, y down, z forward), metres; None if it
            has no depth.
    """

    recognition: Recognition
    box: Box
    position: tuple[float, float, float] | None


def detections_of(frame: RGBDFrame, recognitions: Sequence[Recognition]) -> list[Detection]:
    """Return the detections of a frame with labels, one for each answer."""
    width = frame.depth.shape[1]
    depth = frame.depth_m.ravel()
    detections = []
    for recognition in recognitions:
        pixels = frame.instance_pixels[recognition.label]
        rows, columns = pixels // width, pixels % width
        left, top = int(columns.min()), int(rows.min())
        box = Box(left, top, int(columns.max()) + 1 - left, int(rows.max()) + 1 - top)
        valid = pixels[depth[pixels] > 0]
        position = None
        if len(valid):
            x, y, z = (pixel_rays(valid, width, frame.intrinsics) * depth[valid, None]).mean(axis=0).tolist()
            position = (x, y, z)
        detections.append(Detection(recognition, box, position))
    return detections


def detections_as_json(detections: Sequence[Detection]) -> list[dict[str, Any]]:
    """Return the detections as JSON values: those of the answer, `box` and `position`."""
    return [
        {**dataclasses.asdict(one.recognition), "box": list(one.box), "position": one.position and list(one.position)}
        for one in detections
    ]


def ros_time(stamp: int) -> dict[str, int]:
    """Return the fields of a builtin_interfaces/Time."""
    return {"sec": stamp // 10**9, "nanosec": stamp % 10**9}


def detection_array(detections: Sequence[Detection], *, stamp: int, frame_id: str) -> dict[str, Any]:
    """Return the fields of a vision_msgs/Detection2DArray (version 4, ROS 2), as nested mappings and lists.

    The name is `class_id`, empty for an unknown object, and the confidence is `score`. The position is that of the
    visible points. THOR2 estimates no rotation: that of the pose is the identity. `id` is the number of the track, the
    same in all frames, or of the label in answers without tracks.

    Args:
        detections: of one frame.
        stamp: time of the colour image, nanoseconds.
        frame_id: coordinate frame of the colour camera.
    """
    header = {"stamp": ros_time(stamp), "frame_id": frame_id}
    return {
        "header": header,
        "detections": [
            {"header": header, "results": [_hypothesis(one)], "bbox": _bounding_box(one.box), "id": _identifier(one)}
            for one in detections
        ],
    }


def _identifier(detection: Detection) -> str:
    if not hasattr(detection.recognition, "track"):
        return str(detection.recognition.label)
    track = detection.recognition.track
    return "" if track is None else str(track)


def _hypothesis(detection: Detection) -> dict[str, Any]:
    recognition = detection.recognition
    x, y, z = detection.position or (0.0, 0.0, 0.0)
    pose = {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return {
        "hypothesis": {"class_id": recognition.name or "", "score": float(recognition.confidence or 0.0)},
        "pose": {"pose": pose, "covariance": [0.0] * 36},
    }


def _bounding_box(box: Box) -> dict[str, Any]:
    position = {"x": box.left + (box.width - 1) / 2, "y": box.top + (box.height - 1) / 2}
    center = {"position": position, "theta": 0.0}
    return {"center": center, "size_x": float(box.width), "size_y": float(box.height)}
