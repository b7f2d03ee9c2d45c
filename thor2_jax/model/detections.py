"""Detections: the answers for a frame with the boxes and the positions of the objects.

detections = detections_of(frame, recognizer.recognize(frame))
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

from thor2_jax.frames.frames import RGBDFrame, pixel_rays
from thor2_jax.model.recognition import Recognition

__all__ = ["Box", "Detection", "detections_as_json", "detections_of"]


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
