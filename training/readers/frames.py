"""Labelled frames, one directory each: color.png, depth.png, mask.png, intrinsics.json, labels.json.

The images and the intrinsics may have the other names of `frame_files.FILE_NAMES`.
"""

import dataclasses
import json
from collections.abc import Iterable
from pathlib import Path

from thor2_jax.errors import InputError, with_context
from training.readers.frame_files import FILE_NAMES, frame_files
from training.readers.labelled import LabelledFrame, LabelledFrames

__all__ = ["FrameFolder"]


class FrameFolder(LabelledFrames):
    """The frames in the subdirectories of a directory, or the single frame in the directory itself.

    `labels.json` contains {"labels": {"1": "mug", ...}}; other entries are ignored.
    """

    def __init__(self, path: str | Path) -> None:
        """Find the frames.

        Raises:
            InputError: The path is not a directory, or contains no frame.
        """
        path = Path(path).absolute()  # gives "." a name
        if not path.is_dir():
            raise InputError(f"dataset: {path} is not a directory; expected a dataset")
        self._folders = sorted(f.parent for f in [*path.glob("labels.json"), *path.glob("*/labels.json")])
        if not self._folders:
            raise InputError(f"dataset: {path} has no labels.json and no */labels.json; expected a directory of frames")
        self.identifiers = [folder.name for folder in self._folders]

    def __getitem__(self, number: int) -> LabelledFrame:
        """Read a frame."""
        folder = self._folders[number]
        with with_context(folder.name):
            mask, labels = self.files(number)[2:5:2]
            frame = dataclasses.replace(frame_files(folder), labels=mask).read()
            truth = _truth(labels)
            if truth and set(truth).isdisjoint(frame.instances):
                raise InputError(
                    f"{labels} has the labels {_listed(truth)}, but {mask} has only {_listed(frame.instances)}; "
                    "expected at least one in both: check that the files belong together"
                )
        return LabelledFrame(folder.name, frame, truth, {})

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame."""
        folder = self._folders[number]
        files = frame_files(folder)
        mask = files.labels or folder / FILE_NAMES["labels"][0]
        return [files.color, files.depth, mask, files.intrinsics, folder / "labels.json"]


def _listed(labels: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(labels))) or "background"


def _truth(path: Path) -> dict[int, str]:
    try:
        entries = [(int(label), name) for label, name in json.loads(path.read_bytes())["labels"].items()]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f'{path} is invalid; expected {{"labels": {{"<number>": "<name>", ...}}}}') from None
    truth: dict[int, str] = {}
    for label, name in entries:
        if not isinstance(name, str):
            raise InputError(f"{path}: label {label} has the name {name!r}; expected a string")
        if label in truth:
            raise InputError(f"{path}: label {label} has the names {truth[label]!r} and {name!r}; expected one")
        truth[label] = name
    return truth
