"""Checks of the unit, range and missing pixels of depth, and of the focal length by the sizes of known meshes."""

import math
from collections.abc import Mapping

import numpy as np

from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, RGBDFrame
from training.diagnosis.checks import Diagnosis, Finding

__all__ = ["check_depth", "instance_extents"]

MIN_VALID_INSTANCES = 0.3
"""Smallest plausible fraction of the pixels of instances that have depth."""

MIN_VALID_IMAGE = 0.15
"""Smallest plausible fraction of the pixels of the whole image that have depth, if there are no labels."""

MIN_IN_RANGE = 0.5
"""Smallest plausible fraction of the pixels with depth that lie between `MIN_DEPTH` and `MAX_DEPTH`."""

MIN_EXTENT, MAX_EXTENT = 0.02, 0.45
"""Plausible range of the median longest side of a frame's objects, metres, if no meshes are given."""

EXTENT_MARGIN = 2.0
"""Largest plausible factor by which the median object is smaller or larger than all meshes."""

MAX_RATIO = 1.35
"""Largest plausible median ratio of an object's visible longest side to the longest side of its mesh. It is 0.8 to 1.1
in correct frames and less for occluded objects, so a focal length that is too large cannot be detected."""

MAX_FOCAL_FACTOR = 3.0
"""Largest factor of sizes that is attributed to the focal length; a wrong unit of depth causes larger factors."""

MIN_ROOM, MAX_ROOM = 0.12, 8.0
"""Plausible range of the median depth, metres, if there are no labels to measure."""

USUAL_EXTENT, USUAL_DISTANCE = 0.15, 0.8
"""Typical longest side and distance of objects, metres, for choosing among the possible depth scales."""

DEPTH_SCALES = (1000.0, 10_000.0, 5000.0, 4000.0, 100.0, 1.0)
"""Common depth scales, the most frequent one first."""

MIN_PIXELS = 50
"""Smallest number of pixels with depth for measuring an instance."""


def instance_extents(frame: RGBDFrame) -> dict[int, float]:
    """Return label -> longest side of the visible part of the instance, metres.

    A side is the distance from the 2nd to the 98th percentile along a principal axis of the points. Only points with a
    depth within a quarter of the median are used. Instances with few pixels are left out.
    """
    extents = {}
    depths = frame.depth_m.ravel()
    for label, pixels in frame.instance_pixels.items():
        depth = depths[pixels]
        median = np.median(depth[depth > 0]) if (depth > 0).any() else 0
        chosen = (depth > 0) & (np.abs(depth - median) < 0.25 * median)
        if chosen.sum() >= MIN_PIXELS:
            points = frame.points(pixels[chosen])
            axes = np.linalg.eigh(np.cov(points.T))[1]
            extents[label] = float(np.ptp(np.percentile(points @ axes, (2, 98), axis=0), axis=0).max())
    return extents


def check_depth(
    diagnosis: Diagnosis,
    frame: RGBDFrame,
    mesh_sides: Mapping[str, float] = {},
    names: Mapping[int, str] = {},
    *,
    trust_camera: bool = True,
) -> None:
    """Check the depth of a frame with or without labels.

    Args:
        diagnosis: receives the findings.
        frame: the frame.
        mesh_sides: object -> longest side of its mesh, metres, with which the objects are compared.
        names: label -> object, if known.
        trust_camera: whether the intrinsics are right, so that extents can be used.
    """
    labelled = frame.labels is not None and bool((frame.labels != 0).any())
    depth, where, least = frame.depth_m, "the image", MIN_VALID_IMAGE
    if labelled:
        depth, where, least = depth[frame.label_image != 0], "the instances", MIN_VALID_INSTANCES
    valid = depth[depth > 0]
    if valid.size < least * depth.size:
        diagnosis.add(
            "depth-missing",
            f"Only {valid.size / depth.size:.0%} of the pixels of {where} have depth.",
            "Glass, mirrors and shiny metal give no depth; move closer, avoid sunlight, and check that the depth file "
            "belongs to this frame.",
        )
    if not valid.size:
        return
    extents = instance_extents(frame) if labelled and trust_camera else {}
    median = float(np.median(valid))
    own = {label: mesh_sides[name] for label, name in names.items() if label in extents and name in mesh_sides}
    if not own and len(set(names.values())) > len(mesh_sides) > 0:
        mesh_sides = {}  # of other objects
        diagnosis.notes.append("meshes: of no object in labels.json, so the sizes of the objects were not compared")
    compared, sides = [extents[label] for label in own or extents], [*(own or mesh_sides).values()]
    finding = _wrong_focal_length(median, compared, sides, bool(own)) or _wrong_unit(frame, median, compared, sides)
    if finding is not None:
        diagnosis.findings.append(finding)
        return
    in_range = float(((valid >= MIN_DEPTH) & (valid <= MAX_DEPTH)).mean())
    if in_range < MIN_IN_RANGE:
        diagnosis.add(
            "distance",
            f"{1 - in_range:.0%} of the depth of {where} lies outside {MIN_DEPTH} to {MAX_DEPTH} m (median "
            f"{median:.2f} m) and is not used.",
            "Bring the camera to 0.5 to 1.5 m from the objects; if it is there already, depth_scale is wrong.",
        )
    elif np.ptp(frame.depth_m[frame.depth_m > 0]) == 0:
        message = f"All pixels with depth have the same value, {_length(median)}."
        diagnosis.add("depth-constant", message, "Check that the camera measures depth, and that its file is used.")


def _wrong_focal_length(median: float, extents: list[float], sides: list[float], is_paired: bool) -> Finding | None:
    """Compare the sizes of objects at a plausible distance with their meshes; return a finding if fx, fy are too small.

    Unless each object is paired with its own mesh, as many meshes as objects are compared in the order of their sizes;
    otherwise, the longest mesh is the upper bound for all objects. `_wrong_unit` reports a single instance that is much
    larger, since it may cover several objects.
    """
    if not extents or not sides or not MIN_DEPTH <= median <= MAX_DEPTH:
        return None
    if not is_paired:
        extents, sides = sorted(extents), sorted(sides)
        sides = sides if len(sides) == len(extents) else sides[-1:] * len(extents)
    ratios = np.divide(extents, sides)
    ratio = float(np.median(ratios))
    if not MAX_RATIO < ratio <= (EXTENT_MARGIN if len(ratios) == 1 and not is_paired else MAX_FOCAL_FACTOR):
        return None
    return Finding(
        "intrinsics-focal",
        f"The objects would measure {ratio:.2g} times as much as their meshes (longest sides, median of {len(ratios)}) "
        f"at a distance of {_length(median)}.",
        f"If the distance is right, fx and fy are too small by a factor of about {ratio:.2g}: give the intrinsics of "
        "these images. If it is wrong, depth_scale is.",
    )


def _wrong_unit(frame: RGBDFrame, median: float, extents: list[float], mesh_sides: list[float]) -> Finding | None:
    """Return a finding if the unit of depth is likely wrong."""
    extent = float(np.median(extents)) if extents else None
    low, high, usual, of_meshes = MIN_EXTENT, MAX_EXTENT, USUAL_EXTENT, ""
    if mesh_sides:
        low, high = min(mesh_sides) / EXTENT_MARGIN, max(mesh_sides) * EXTENT_MARGIN
        usual = float(np.median(mesh_sides))
        of_meshes = f"; the meshes measure {_length(min(mesh_sides))} to {_length(max(mesh_sides))}"
    if MIN_ROOM <= median <= MAX_ROOM if extent is None else low <= extent <= high:
        return None
    is_metric, is_usable = frame.depth.dtype.kind == "f", MIN_DEPTH <= median <= MAX_DEPTH
    distance = _length(median) + ("" if is_metric else f" with depth_scale {frame.intrinsics.depth_scale:g}")
    measured = f"The median depth would be {distance}"
    if extent is not None:
        size = f"{_length(extent)} (median of their longest sides)"
        measured = f"The objects would measure {size} at a distance of {distance}{of_meshes}"

    def misfit(factor: float) -> float:
        """Return the misfit of depth times a factor, or infinity if it is implausible."""
        fits = extent is None or low <= extent * factor <= high
        if not fits or not MIN_DEPTH <= median * factor <= MAX_DEPTH:
            return math.inf
        of_distance = abs(math.log(median * factor / USUAL_DISTANCE))
        return of_distance if extent is None else of_distance + abs(math.log(extent * factor / usual))

    scale = 1.0 if is_metric else frame.intrinsics.depth_scale
    best = min(DEPTH_SCALES, key=lambda each: misfit(scale / each))
    would_be = f"would be {_length(median * scale / best)}"
    rule = "Set depth_scale to the number of depth units per metre (1000 for millimetres)."
    remedy = f"With depth_scale {best:g} (units per metre) the median distance {would_be}: set it in the intrinsics or "
    remedy += "by --depth-scale."
    if is_metric:
        rule = "Floating-point depth must be in metres."
        remedy = f"{rule} Divide it by {best:g}: the median {would_be}."
    other = " If the distance is right, the focal length or the labels are wrong." if is_usable else ""
    advice = remedy if misfit(scale / best) < math.inf else rule + other
    if extent is not None and len(frame.instances) == 1 and extent > high and is_usable:
        return Finding(
            "labels-foreground",
            f"{measured}: the only number of the label image seems to cover several objects.",
            "Give each object a number of its own. If it is one object, the unit of depth is wrong: " + advice,
        )
    return Finding("depth-unit", f"{measured}: the unit of depth is likely wrong.", advice)


def _length(metres: float) -> str:
    return f"{1000 * metres:.3g} mm" if metres < 0.01 else f"{metres:.3g} m"
