"""The answers for the instances of a frame, and where the objects are."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from thor2_jax.frames.frames import RGBDFrame

__all__ = [
    "AnswerBy",
    "Box",
    "Detection",
    "Recognition",
    "detections_as_json",
    "detections_of",
    "overflow_reason",
]

AnswerBy = Literal["classifiers", "gallery", "both"]
"""Sources of answers."""

MAX_OVERFLOW = 0.5
"""Largest overflow of an answer with a name, as a fraction of the points; beyond it, the descriptor misses too much."""


def overflow_reason(overflow: int, n_points: int) -> str | None:
    """Return why an instance with this overflow and number of points gets no name; None if it may get one."""
    if overflow <= MAX_OVERFLOW * n_points:
        return None
    return (
        f"overflow: {overflow} points and pairs of {n_points} points lie outside the descriptor's grid; check the "
        "intrinsics and the depth scale; objects far larger than 40 cm do not fit"
    )


@dataclasses.dataclass(frozen=True)
class Recognition:
    """The answer for one instance of a frame.

    Attributes:
        label: number of the instance in the label image.
        name: the object's name. None if the instance could not be described (fewer points than
            `prepared_instance.MIN_POINTS`), if more than half of its points overflow (`MAX_OVERFLOW`), or if the object
            is unknown. Unknown objects have a confidence below the threshold (see `inference.answers`).
        confidence: from 0 to 1, also for unknown objects: estimated probability that the name is correct if the object
            is known; low for most unknown objects (see `model.fusion`). For an enrolled object, it follows from the
            score of the gallery. Without a calibration, it is the fused probability of the most probable class. None if
            the instance could not be described.
        classifier: the classifier that gives this class the largest probability ("tops", "tops2" or "embedding"), or
            "gallery".
        top: classifier or "gallery" -> its five most probable (name, probability) pairs.
        occluded: whether another instance occludes a part of the instance, or the image border cuts it.
        overflow: number of points and persistence pairs outside the descriptor's grid, see `Descriptors`.
        points_used: number of points of the described cloud.
        kept_by_fallback: whether an outlier rule was skipped, since it would have dropped most of the cloud.
        reason: why `name` is None; None if there is a name.
    """

    label: int
    name: str | None = None
    confidence: float | None = None
    classifier: str | None = None
    top: dict[str, list[tuple[str, float]]] = dataclasses.field(default_factory=dict)
    occluded: bool = False
    overflow: int = 0
    points_used: int = 0
    kept_by_fallback: bool = False
    reason: str | None = None


class Box(NamedTuple):
    """The smallest rectangle of whole pixels around an instance."""

    left: int
    top: int
    width: int
    height: int


@dataclasses.dataclass(frozen=True)
class Detection:
    """The answer for an instance, and the position of the instance.

    Attributes:
        recognition: the answer.
        box: box around the instance in the image, pixels.
        position: mean of the visible points in the OpenCV camera frame (x right, y down, z forward), metres; None if
            the instance has no depth.
    """

    recognition: Recognition
    box: Box
    position: tuple[float, float, float] | None


def detections_of(frame: RGBDFrame, recognitions: Sequence[Recognition]) -> list[Detection]:
    """Return the detections of a frame with labels, one for each answer."""
    width = frame.depth.shape[1]
    detections = []
    for recognition in recognitions:
        pixels = frame.instance_pixels[recognition.label]
        rows, columns = np.divmod(pixels, width)
        box = Box(int(columns.min()), int(rows.min()), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)
        points, position = frame.points(pixels), None
        points = points[points[:, 2] > 0]
        if len(points):
            x, y, z = points.mean(axis=0).tolist()
            position = (x, y, z)
        detections.append(Detection(recognition, box, position))
    return detections


def detections_as_json(detections: Sequence[Detection]) -> list[dict[str, Any]]:
    """Return the detections as JSON values: the fields of the answer, `box` and `position`."""
    return [
        {**dataclasses.asdict(one.recognition), "box": list(one.box), "position": one.position and list(one.position)}
        for one in detections
    ]
