"""The diagnosis of a whole set-up: the files of a frame, a model and meshes.

for finding in diagnose(FrameFiles(color, depth, labels, intrinsics)).findings:
    print(finding.message, finding.advice)
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from thor2_jax import InputError, Recognizer, RGBDFrame
from thor2_jax.frames.frames import frame_intrinsics, read_color, read_depth, read_labels
from training.diagnosis.checks import Diagnosis, check_camera, check_labels, check_meshes
from training.diagnosis.colors import check_channel_order, check_light
from training.diagnosis.depth import check_depth
from training.diagnosis.registration import check_labels_alignment, check_registration
from training.readers.frames import FrameFiles

__all__ = ["diagnose"]

T = TypeVar("T")


def diagnose(
    files: FrameFiles | RGBDFrame,
    *,
    depth_scale: float | None = None,
    recognizer: Recognizer | None = None,
    meshes: Mapping[str, Path] = {},
    mesh_scale: float = 1.0,
) -> Diagnosis:
    """Diagnose the set-up with which a frame was recorded.

    If there is a `labels.json` beside the labels, each object is compared with its own mesh.

    Args:
        files: the files of a frame, with or without labels, or the frame.
        depth_scale: depth units per metre, replacing the depth scale in the intrinsics of the files.
        recognizer: a trained recognizer, needed to check the order of the colour channels.
        meshes: object -> mesh file.
        mesh_scale: factor from the unit of the meshes to metres.

    Raises:
        InputError: a file is missing.
        OSError: a file cannot be opened.
    """
    diagnosis = Diagnosis()
    sides = check_meshes(diagnosis, meshes, mesh_scale)
    names: Mapping[int, str] = {}
    if isinstance(files, FrameFiles):
        missing = [path for path in vars(files).values() if path and not path.exists()]
        if missing:
            raise InputError(f"{missing[0]} is missing; expected the files of a frame")
        color = _read(diagnosis, "color", lambda: read_color(files.color))
        depth = _read(diagnosis, "depth", lambda: read_depth(files.depth))
        labels = _read(diagnosis, "labels", lambda: None if files.labels is None else read_labels(files.labels))
        camera = _read(diagnosis, "intrinsics", lambda: frame_intrinsics(files.intrinsics, files.color, depth_scale))
        if files.labels is None:
            diagnosis.notes.append("labels: not given, so the sizes of the objects were not checked")
        elif files.names.is_file():
            names = _read(diagnosis, "names", files.read_names) or {}
    else:
        color, depth, labels, camera = files.color, files.depth, files.labels, files.intrinsics
    depth, labels = _aligned(diagnosis, "depth", depth, color), _aligned(diagnosis, "labels", labels, color)
    shape = next((image.shape[:2] for image in (color, depth, labels) if image is not None), None)
    camera_is_right = (
        camera is not None and shape is not None and _passes(diagnosis, check_camera, camera, shape[1], shape[0])
    )
    if labels is not None and not _passes(diagnosis, check_labels, labels):
        labels = None
    light_is_right = color is not None and _passes(diagnosis, check_light, color, labels)
    if color is not None and labels is not None:
        check_labels_alignment(diagnosis, color, labels)
    if depth is None or camera is None:
        return diagnosis
    unsized = dataclasses.replace(camera, width=None, height=None)  # its size was checked
    seen = np.zeros((*depth.shape, 3), np.uint8) if color is None else color
    frame = _read(diagnosis, "intrinsics", lambda: RGBDFrame(seen, depth, labels, unsized))
    if frame is None:  # the lens distortion has no inverse
        return diagnosis
    is_registered = color is None or _passes(diagnosis, check_registration, color, frame.depth_m)
    trust_camera = camera_is_right and is_registered  # Without registration, the labels belong to other pixels.
    depth_is_right = _passes(diagnosis, check_depth, frame, sides, names, trust_camera=trust_camera)
    _check_order(diagnosis, frame, recognizer, light_is_right and trust_camera and depth_is_right)
    return diagnosis


def _aligned(
    diagnosis: Diagnosis, name: str, image: NDArray[Any] | None, color: NDArray[np.uint8] | None
) -> NDArray[Any] | None:
    """Return an image if it has the size of the colour image; otherwise, add a finding."""
    if image is None or color is None or image.shape == color.shape[:2]:
        return image
    size, color_size = (f"{each.shape[1]} x {each.shape[0]}" for each in (image, color))
    diagnosis.add(
        "size",
        f"{name} has {size} pixels, but color has {color_size}.",
        "Colour, depth and labels must have the same size, pixel for pixel: use the depth image that the driver aligns "
        "to colour.",
    )
    return None


def _passes(diagnosis: Diagnosis, check: Callable[..., None], *arguments: Any, **options: Any) -> bool:
    """Return whether a check adds no finding."""
    n_findings = len(diagnosis.findings)
    check(diagnosis, *arguments, **options)
    return len(diagnosis.findings) == n_findings


def _check_order(diagnosis: Diagnosis, frame: RGBDFrame, recognizer: Recognizer | None, is_sound: bool) -> None:
    """Check the order of the channels, or note why it is not checked."""
    subject = "order of the colour channels (RGB or BGR): not checked"
    if recognizer is None:
        diagnosis.notes.append(f"{subject}, since this needs a model that is trained on the objects (--model)")
    elif frame.labels is None:
        diagnosis.notes.append(f"{subject}, since there are no labels")
    elif not is_sound:
        diagnosis.notes.append(f"{subject} until the other findings are resolved")
    else:
        check_channel_order(diagnosis, frame, recognizer)


def _read(diagnosis: Diagnosis, name: str, read: Callable[[], T]) -> T | None:
    """Read a file; add a finding if it is of the wrong kind."""
    try:
        return read()
    except InputError as error:
        diagnosis.add(f"unreadable-{name}", f"{name} cannot be used: {error}.", "Formats: docs/frames.md.")
        return None
