"""Findings of a diagnosis, and checks of the intrinsics, the label image and the unit of meshes."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from thor2_jax import InputError, Intrinsics
from training.objects.meshes import MAX_SIDE, MIN_SIDE, read_mesh

__all__ = ["Diagnosis", "Finding", "check_camera", "check_labels", "check_meshes"]


@dataclasses.dataclass(frozen=True)
class Finding:
    """A likely mistake in a set-up.

    Attributes:
        code: short name of the problem, for machines: "depth-unit", "intrinsics-size", ...; docs/frames.md lists them.
        message: the measurement and its meaning, for users.
        advice: advice to the user.
    """

    code: str
    message: str
    advice: str


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        findings: likely mistakes; empty for a sound set-up.
        notes: checks that were not possible, with the reasons.
    """

    findings: list[Finding] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)

    def add(self, code: str, message: str, advice: str) -> None:
        """Add a finding."""
        self.findings.append(Finding(code, message, advice))


MAX_OFF_CENTRE = 0.12
"""Largest distance of the principal point from the image centre, as a fraction of the side; usual cameras have 0.03."""

MAX_PIXEL_ASPECT = 1.15
"""Largest ratio of the focal lengths."""

MIN_VIEW, MAX_VIEW = 20.0, 120.0
"""Range of horizontal fields of view of depth cameras, degrees, with a margin."""

ADVICE = "Give the intrinsics of these images: after resizing by a factor, fx, fy, cx and cy are multiplied by it."


def check_camera(diagnosis: Diagnosis, intrinsics: Intrinsics, width: int, height: int) -> None:
    """Check intrinsics against the size of the colour image in pixels."""
    size = intrinsics.width or width, intrinsics.height or height
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    if size != (width, height):
        message = f"The intrinsics are for images of {size[0]} x {size[1]} pixels, but color has {width} x {height}."
        diagnosis.add("intrinsics-size", message, ADVICE)
    elif max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > MAX_OFF_CENTRE:
        if max(abs(cy / width - 0.5), abs(cx / height - 0.5)) <= MAX_OFF_CENTRE:
            reason, advice = "cx and cy are exchanged", "Exchange cx and cy (and fx and fy)."
        else:
            reason = f"it suits an image of about {2 * cx:.0f} x {2 * cy:.0f} pixels: K does not fit the image size"
            advice = ADVICE + " If the image is cropped, subtract its left and upper margins from cx and cy."
        diagnosis.add(
            "intrinsics-size",
            f"The principal point cx, cy = {cx:g}, {cy:g} is far from the centre of the image of {width} x {height} "
            f"pixels; {reason}.",
            advice,
        )
    aspect = fx / fy
    if not 1 / MAX_PIXEL_ASPECT <= aspect <= MAX_PIXEL_ASPECT:
        diagnosis.add(
            "intrinsics-aspect",
            f"The focal lengths fx, fy = {fx:g}, {fy:g} differ by {100 * abs(aspect - 1):.0f} %; pixels of depth "
            "cameras are square.",
            "Check whether width and height were resized by different factors, and the order of fx, fy, cx, cy.",
        )
    view = math.degrees(2 * math.atan(width / 2 / fx))
    if not MIN_VIEW <= view <= MAX_VIEW:
        diagnosis.add(
            "intrinsics-focal",
            f"fx = {fx:g} pixels means a horizontal field of view of {view:.1f} degrees; depth cameras have "
            f"{MIN_VIEW:.0f} to {MAX_VIEW:.0f}.",
            "fx and fy are in pixels of these images, not in millimetres. " + ADVICE,
        )


MAX_INSTANCES = 150
"""Largest plausible number of instances on a table."""

MAX_INSTANCE_SHARE = 0.6
"""Largest plausible fraction of the image covered by one instance."""

MAX_THIN_SHARE = 0.34
"""Largest plausible fraction of thin instances, which vanish if their border of one pixel is removed."""

MIN_THIN = 3
"""Smallest number of thin instances for a finding."""

MIN_PIECES, MIN_PIECE_SHARE = 3, 0.08
"""Smallest number of pieces, and fraction of each, at which the only instance is taken for a foreground mask."""


def check_labels(diagnosis: Diagnosis, labels: NDArray[Any]) -> None:
    """Check whether an image [H, W] of integers contains instance numbers."""
    values, counts = np.unique(labels[labels != 0], return_counts=True)
    advice = "Give an image in which 0 is background and each object has a number of its own; see docs/frames.md."
    if not len(values):
        diagnosis.add("labels-empty", "The label image has no instance: all of it is 0, which is background.", advice)
        return
    # A pixel is inside if its eight neighbours have its label.
    inside = (ndimage.minimum_filter(labels, 3) == labels) & (ndimage.maximum_filter(labels, 3) == labels)
    thick = np.isin(values, labels[inside & (labels != 0)])
    n_thin = int((~thick).sum())
    largest = counts.max() / labels.size
    if len(values) > MAX_INSTANCES:
        message = f"The label image has {len(values)} different numbers: it looks like a photo, a depth image or noise."
        diagnosis.add("labels-many", message, advice)
    elif n_thin >= MIN_THIN and n_thin > MAX_THIN_SHARE * len(values):
        diagnosis.add(
            "labels-thin",
            f"{n_thin} of the {len(values)} instances are nowhere three pixels wide, as in a label image that was "
            "resized or rotated with interpolation, or compressed with losses.",
            "Resize label images with nearest-neighbour interpolation and store them as PNG.",
        )
    elif largest > MAX_INSTANCE_SHARE:
        instance = f"Instance {values[counts.argmax()]} covers {largest:.0%} of the image"
        message = f"{instance}: the background seems to have a number."
        diagnosis.add("labels-background", message, "The background must be 0. " + advice)
    elif len(values) == 1:
        pieces = np.bincount(ndimage.label(labels != 0, np.ones((3, 3)))[0].ravel())[1:]
        n_pieces = int((pieces > MIN_PIECE_SHARE * counts[0]).sum())
        if n_pieces >= MIN_PIECES:
            diagnosis.add(
                "labels-foreground",
                f"The only number, {values[0]}, covers {n_pieces} separate regions: this looks like a mask of the "
                "foreground, not of instances.",
                advice,
            )


USUAL_SIDE = (0.03, 0.6)
"""Plausible range of the median longest side of objects on a table, metres."""

SCALES = {0.001: "millimetres", 0.01: "centimetres", 0.0254: "inches", 1000.0: "kilometres"}


def check_meshes(diagnosis: Diagnosis, meshes: Mapping[str, Path], scale: float = 1.0) -> dict[str, float]:
    """Check the unit of mesh files; return object -> longest side in metres, empty if the unit is likely wrong.

    Args:
        diagnosis: receives the findings.
        meshes: object -> mesh file.
        scale: factor from the unit of the meshes to metres.
    """
    sides = {}
    for name, path in meshes.items():
        try:
            sides[name] = read_mesh(path, scale).longest_side
        except InputError as error:
            diagnosis.add("mesh", f"A mesh cannot be used: {error}.", "Repair it, or leave it out.")
    if not sides:
        return {}
    median = float(np.median(list(sides.values())))
    if MIN_SIDE <= min(sides.values()) and max(sides.values()) <= MAX_SIDE and median >= USUAL_SIDE[0] / 3:
        return sides
    fitting = [each for each in SCALES if USUAL_SIDE[0] <= median * each <= USUAL_SIDE[1]]
    unit, remedy = "its unit is unknown", "--mesh-scale sets the factor"
    if fitting:
        unit, remedy = f"it is likely in {SCALES[fitting[0]]}", f"give --mesh-scale {fitting[0] * scale:g}"
    measured = f"meshes is {median:.4g} (median)" if len(sides) > 1 else f"mesh is {median:.4g}"
    usual = f"{USUAL_SIDE[0]:g} to {USUAL_SIDE[1]:g}"
    message = f"The longest side of the {measured}; in metres, objects on a table have {usual}: {unit}."
    diagnosis.add("mesh-unit", message, f"Meshes are read in metres; {remedy}.")
    return {}
