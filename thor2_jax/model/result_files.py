"""Files with the recognitions of frames: JSON and overlay, COCO results, BOP results.

Frames and objects have names. COCO and BOP use numbers instead, see `image_numbers` and `category_numbers`.
"""

import dataclasses
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask  # type: ignore[import-untyped]

from thor2_jax.errors import InputError
from thor2_jax.files import has_json, new_directory, write_text
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.overlay import draw_overlay
from thor2_jax.model.recognition import Detection, Recognition

__all__ = [
    "RESULT_FILES",
    "ResultTables",
    "check_no_foreign_results",
    "is_bop_file",
    "is_coco_file",
    "write_recognitions",
]

RESULT_FILES = ("recognition.json", "overlay.png")

BOP_HEADER = "scene_id,im_id,obj_id,score,R,t,time"
_IDENTITY = "1 0 0 0 1 0 0 0 1"


def check_no_foreign_results(out: Path) -> None:
    """Raise InputError if `write_recognitions` would overwrite a file that is not one of its own."""
    names = [name for name in RESULT_FILES if (out / name).exists()]
    if names and not has_json(out / RESULT_FILES[0], ("label", "name", "confidence", "points_used")):
        raise InputError(f"out: {out} has {names[0]}, which this command has not written; choose another directory")


def is_coco_file(path: Path) -> bool:
    """Return whether a file has the entries of COCO results that `ResultTables` writes."""
    return has_json(path, ("image_id", "category_id", "frame", "category_name"))


def is_bop_file(path: Path) -> bool:
    """Return whether a file has BOP results as `ResultTables` writes them, where every rotation is the identity."""
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
    except (OSError, ValueError):
        return False
    return header == BOP_HEADER and all(f",{_IDENTITY}," in line for line in lines)


def write_recognitions(out: Path, frame: RGBDFrame, recognitions: Sequence[Recognition]) -> None:
    """Write `recognition.json`, one object per instance, and `overlay.png` to a directory; create it if necessary.

    Raises:
        OSError: a file cannot be written.
    """
    instances = [dataclasses.asdict(recognition) for recognition in recognitions]
    with new_directory(out):
        write_text(out / RESULT_FILES[0], json.dumps(instances, indent=1) + "\n")
        draw_overlay(frame, recognitions, out / RESULT_FILES[1])


def image_numbers(names: Sequence[str]) -> list[tuple[int, int]]:
    """Return scene number and image number of each frame.

    The numbers are the last two parts of the name (`000048/000001`: scene 48, image 1; `000001`: scene 1) if these are
    numbers that differ between the frames; otherwise all frames are in scene 1 and are counted from 1.
    """
    matches = (re.fullmatch(r"(?:(?:.*/)?(\d+)/)?(\d+)", name, re.DOTALL) for name in names)
    numbers = [(int(match[1] or 1), int(match[2])) for match in matches if match]
    if len(set(numbers)) < len(names):
        return [(1, position) for position in range(1, len(names) + 1)]
    return numbers


def category_numbers(classes: Sequence[str], names: Mapping[int, str] | None = None) -> dict[str, int]:
    """Return class -> number.

    Args:
        classes: names of the objects.
        names: number -> name; other classes get no number. By default `obj_000012` has the number 12 if all classes
            have such names with different numbers, and otherwise the classes are counted from 1.

    Raises:
        InputError: a class has several numbers in `names`.
    """
    if names is not None:
        number_of = {name: number for number, name in names.items()}
        if repeated := [name for number, name in names.items() if name in classes and number_of[name] != number]:
            raise InputError(f"names has several numbers of {repeated[0]!r}; expected one of each name")
        return {name: number_of[name] for name in classes if name in number_of}
    matches = (re.fullmatch(r"obj_(\d+)", name) for name in classes)
    numbers = [int(match[1]) for match in matches if match]
    if len(set(numbers)) < len(classes):
        numbers = list(range(1, len(classes) + 1))
    return dict(zip(classes, numbers, strict=True))


class ResultTables:
    """The COCO and BOP results of all frames, filled frame by frame and written at the end.

    Instances without a name, or whose name has no number, are in neither file. THOR2 does not estimate poses: in the
    BOP results (`BOP_HEADER`), R is the identity and t is the mean of the visible points, in millimetres.

    Attributes:
        n_without_number: number of recognized instances whose class has no number.
    """

    def __init__(self, frames: Sequence[str], classes: Sequence[str], names: Mapping[int, str] | None = None) -> None:
        """Number the frames and the classes.

        Args:
            frames: names of all frames, see `image_numbers`.
            classes: names of all objects.
            names: number -> name, see `category_numbers`.
        """
        self._categories = category_numbers(classes, names)
        self._images = dict(zip(frames, image_numbers(frames), strict=True))
        self._has_scenes = len({scene for scene, _ in self._images.values()}) > 1
        self._places = {name: place for place, name in enumerate(frames, 1)}
        self._coco: list[dict[str, Any]] = []
        self._bop: list[str] = []
        self.n_without_number = 0

    def add(self, name: str, frame: RGBDFrame, detections: Iterable[Detection], seconds: float) -> None:
        """Add the detections of a frame.

        Args:
            name: name of the frame; each COCO entry contains it and the name of the object.
            frame: the frame.
            detections: the detections in the frame.
            seconds: time for the whole frame.
        """
        scene, image = self._images[name]
        for detection in detections:
            answer = detection.recognition
            if answer.name is None:
                continue
            category = self._categories.get(answer.name)
            if category is None:
                self.n_without_number += 1
                continue
            mask = coco_mask.encode(np.asfortranarray(frame.label_image == answer.label, np.uint8))
            self._coco.append(
                {
                    # COCO has no scenes: images of several scenes are counted from 1.
                    "image_id": self._places[name] if self._has_scenes else image,
                    "category_id": category,
                    "bbox": list(detection.box),
                    "score": answer.confidence,
                    "segmentation": {**mask, "counts": mask["counts"].decode("ascii")},
                    "frame": name,
                    "category_name": answer.name,
                }
            )
            assert detection.position is not None  # An object with a name has points.
            place = " ".join(f"{1000 * value:.3f}" for value in detection.position)
            self._bop.append(f"{scene},{image},{category},{answer.confidence},{_IDENTITY},{place},{seconds:.4f}")

    def write(self, coco: Path | None = None, bop: Path | None = None) -> None:
        """Write COCO results as JSON and BOP results as CSV to the given paths, and create the directories.

        Raises:
            OSError: a file cannot be written.
        """
        contents = {coco: json.dumps(self._coco), bop: "\n".join([BOP_HEADER, *self._bop])}
        for path, content in contents.items():
            if path is not None:
                with new_directory(path.parent):
                    write_text(path, content + "\n")
