"""Detections as the fields of a vision_msgs/Detection2DArray.

detection_array(detections, stamp=stamp, frame_id="camera_color_optical_frame")
"""

from collections.abc import Sequence
from typing import Any

from thor2_jax.model.recognition import Box, Detection

__all__ = ["detection_array", "ros_time"]


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
