"""Labelled frames: color.png, depth.png, mask.png, intrinsics.json and labels.json in a folder of each frame.

The images and the intrinsics may have the other names of `frame_files.FILE_NAMES`.
"""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from thor2_jax.errors import InputError, with_context
from thor2_jax.files import read_file
from training.readers.frame_files import FILE_NAMES, FrameFiles, FrameSource, find_frames
from training.readers.labelled import LabelledFrame, LabelledFrames, named_labels

__all__ = ["FrameFolder", "read_names"]

MAX_LISTED = 5
"""Frames without labels that the note lists."""


class FrameFolder(LabelledFrames):
    """The frames of a folder, or any others, whose objects are named by `labels.json` beside their labels.

    `labels.json` contains {"labels": {"1": "mug", ...}}; other entries are ignored.

    Attributes:
        named: whether the frames have a labels.json.
        note: which frames are left out, since they have no labels.json; empty if none are.
    """

    def __init__(self, frames: str | Path | Sequence[FrameSource], *, named: bool = True) -> None:
        """Find the frames.

        Args:
            frames: a folder as `find_frames` takes it, or frames.
            named: False takes all frames if none of them has a labels.json; their objects have no names.

        Raises:
            InputError: the path is not a directory or contains no frame, or no frame has a labels.json.
        """
        sources = find_frames([Path(frames)]) if isinstance(frames, str | Path) else frames
        labelled: list[FrameSource] = []
        others: list[FrameSource] = []
        for source in sources:
            (labelled if source.files and source.files.names.is_file() else others).append(source)
        self.named = bool(labelled)
        if named and not self.named:
            raise InputError(
                f"frames: {_first_names(sources)} has no labels.json; expected the names of the objects in the frames"
            )
        self._sources = labelled or sources
        self.identifiers = [source.name for source in self._sources]
        left_out = others if labelled else []
        self.note = f"{len(left_out)} frames without labels.json: {_first_names(left_out)}" if left_out else ""

    def __getitem__(self, number: int) -> LabelledFrame:
        """Read a frame."""
        source = self._sources[number]
        with with_context(source.name):
            files = source.files
            if files is None or not self.named:
                return LabelledFrame(source.name, source.read(), {}, {})
            mask = _mask(files)
            if not mask.is_file():
                raise InputError(f"{mask} is missing")
            frame, truth = source.read(), read_names(files.names)
            if truth and set(truth).isdisjoint(frame.instances):
                raise InputError(
                    f"{files.names} has the labels {_listed(truth)}, but {mask} has only {_listed(frame.instances)}; "
                    "expected at least one in both: check that the files belong together"
                )
        return LabelledFrame(source.name, frame, truth, {})

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame; none are known of a recording."""
        files = self._sources[number].files
        return [files.color, files.depth, _mask(files), files.intrinsics, files.names] if files else []


def _mask(files: FrameFiles) -> Path:
    return files.labels or files.color.with_name(FILE_NAMES["labels"][0])


def _first_names(sources: Sequence[FrameSource]) -> str:
    return ", ".join(source.name for source in sources[:MAX_LISTED]) + (", ..." if len(sources) > MAX_LISTED else "")


def _listed(labels: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(labels))) or "background"


def read_names(path: Path) -> dict[int, str]:
    """Read `labels.json`: label -> name of the object; raises InputError and OSError."""
    try:
        entries = [(int(label), name) for label, name in json.loads(read_file(path))["labels"].items()]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f'{path} is invalid; expected {{"labels": {{"<number>": "<name>", ...}}}}') from None
    return named_labels(path, entries)
