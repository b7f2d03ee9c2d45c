"""Frames to recognize: folders with the files of one frame each, BOP scenes, recordings; and files of camera poses."""

import dataclasses
import functools
import itertools
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import read_file
from thor2_jax.frames.frames import Intrinsics, RecordedFrame, RGBDFrame, read_frame
from thor2_jax.recordings.bags import Bag
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from training.readers.bop import BOP
from training.readers.labelled import named_path

__all__ = [
    "FILE_NAMES",
    "FrameFiles",
    "FrameSource",
    "find_frames",
    "frame_files",
    "read_poses",
    "recorded_sources",
    "segmented_source",
]

FILE_NAMES = {
    "color": ("color.png", "color.jpg", "color.jpeg", "rgb.png", "rgb.jpg"),
    "depth": ("depth.png", "depth.tiff", "depth.tif", "depth.npy", "depth.exr"),
    "labels": ("mask.png", "labels.png"),
    "intrinsics": (
        "intrinsics.json",
        "intrinsics.yaml",
        "camera_info.yaml",
        "camera_info.json",
        "camera.json",
        "K.txt",
        "cam_K.txt",
        "K.npy",
        "K.json",
    ),
}
"""Names of the files of a frame; the first one that exists is read."""


@dataclasses.dataclass(frozen=True)
class FrameFiles:
    """The files of a frame: the arguments of `read_frame`, and labels.json, which may name the objects beside them.

    Attributes:
        color: colour image.
        depth: depth image.
        labels: label image; None for a frame without labels.
        intrinsics: file with the camera.
    """

    color: Path
    depth: Path
    labels: Path | None
    intrinsics: Path

    def read(self, depth_scale: float | None = None) -> RGBDFrame:
        """Read the frame; arguments and exceptions as `read_frame`."""
        return read_frame(**vars(self), depth_scale=depth_scale)

    @property
    def names(self) -> Path:
        """The file with the names of the objects, which need not exist."""
        return (self.labels or self.color).with_name("labels.json")

    def source(self, name: str, depth_scale: float | None = None) -> "FrameSource":
        """Return the frame of these files."""
        return FrameSource(name, functools.partial(self.read, depth_scale), self)


@dataclasses.dataclass(frozen=True)
class FrameSource:
    """A frame that can be read.

    Attributes:
        name: its folder, or scene and image.
        read: function that returns the frame; raises InputError and OSError. Worker processes get it pickled.
        files: its files; None for a frame of a BOP scene or a recording, and for one that is segmented.
    """

    name: str
    read: Callable[[], RGBDFrame]
    files: FrameFiles | None = None


def frame_files(folder: Path) -> FrameFiles:
    """Return the files of the frame in a folder.

    A file that is missing has its first name; a label image that is missing is None.
    """

    def existing(kind: str) -> Path | None:
        return next((folder / name for name in FILE_NAMES[kind] if (folder / name).is_file()), None)

    color, depth, intrinsics = (
        existing(kind) or folder / FILE_NAMES[kind][0] for kind in ("color", "depth", "intrinsics")
    )
    return FrameFiles(color, depth, existing("labels"), intrinsics)


def find_frames(paths: Sequence[Path], depth_scale: float | None = None) -> list[FrameSource]:
    """Find the frames in folders, in the order of their names, which are unique.

    Args:
        paths: folders of one frame, folders that hold such folders at any depth or links to them, and BOP splits or
            scenes.
        depth_scale: see `read_frame`; BOP scenes have their own.

    Raises:
        InputError: a path is no directory or holds no frame, a frame is given twice, or `depth_scale` is out of range.
    """
    if depth_scale is not None:
        Intrinsics(1.0, 1.0, 0.0, 0.0, depth_scale)
    sources: list[FrameSource] = []
    folders: list[Path] = []
    for path in paths:
        path = named_path(path)
        if not path.is_dir():
            raise InputError(f"frames: {path} is not a directory; expected a folder of frames")
        if any(path.glob("scene_camera.json")) or any(path.glob("*/scene_camera.json")):
            dataset = BOP(path)
            of_path = [
                FrameSource(name, functools.partial(_read_bop, dataset, k))
                for k, name in enumerate(dataset.identifiers)
            ]
        else:
            # "**" does not follow links to folders, "*" does. A frame without colour is found too, so that it fails.
            names = [*FILE_NAMES["color"], *FILE_NAMES["depth"]]
            images = [file for name in names for pattern in (f"**/{name}", f"*/{name}") for file in path.glob(pattern)]
            of_path = [
                frame_files(folder).source(
                    folder.name if folder == path else folder.relative_to(path).as_posix(), depth_scale
                )
                for folder in sorted({file.parent for file in images})
            ]
        if not of_path:
            raise InputError(f"frames: {path} has no {' or '.join(FILE_NAMES['color'])}; expected a folder of frames")
        sources += of_path
        folders += [path if each.files and each.files.color.parent == path else path / each.name for each in of_path]
    names = [source.name for source in sources]
    if len(set(names)) == len(names):
        return sources
    # Frames in different folders may have the same name: they are then named from the folder that holds all of them.
    common = Path(os.path.commonpath([path.parent for path in folders]))
    names = [path.relative_to(common).as_posix() for path in folders]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(f"frames: {repeated[0]} is given twice; give each folder once, or one that holds both")
    return [dataclasses.replace(source, name=name) for source, name in zip(sources, names, strict=True)]


def segmented_source(source: FrameSource | RecordedFrame, segmenter: Segmenter) -> FrameSource:
    """Return a frame that is segmented when it is read; labels that it has are replaced."""
    return FrameSource(source.name, functools.partial(_read_segmented, source, segmenter))


def _read_segmented(source: FrameSource | RecordedFrame, segmenter: Segmenter) -> RGBDFrame:
    return segmented(source.read(), segmenter)


def _read_bop(dataset: BOP, number: int) -> RGBDFrame:
    return dataset[number].frame


def read_poses(path: Path, names: Sequence[str]) -> list[NDArray[np.float64]]:
    """Return the pose [4, 4] of each frame, from camera to world coordinates in metres.

    Args:
        path: JSON file with an object, frame name -> matrix, or with a list of matrices in the order of the frames.
        names: names of the frames.

    Raises:
        InputError: the file is invalid, a frame has no pose, there is another number of poses than of frames, or a
            pose is not a rigid motion. The message names the file.
        OSError: the file cannot be read.
    """
    from thor2_jax.tracking.viewpoints import check_pose  # imports SciPy

    try:
        stored = json.loads(read_file(path))
    except (ValueError, RecursionError):
        stored = None
    if not isinstance(stored, (dict, list)):
        raise InputError(f"poses: {path} is invalid; expected JSON: frame name -> [4, 4] matrix, or a list of matrices")
    if isinstance(stored, dict):
        missing = [name for name in names if name not in stored]
        if missing:
            raise InputError(f"poses: {path} has no pose of frame {missing[0]}; expected one for each frame")
        stored = [stored[name] for name in names]
    if len(stored) != len(names):
        raise InputError(f"poses: {path} has {len(stored)} poses for {len(names)} frames; expected one for each frame")
    return [
        check_pose(pose, f"poses: {path}: the pose of frame {name}") for name, pose in zip(names, stored, strict=True)
    ]


def recorded_sources(open_bag: Callable[[], Bag], every: int = 1) -> tuple[list[FrameSource], list[str]]:
    """Return the frames of a recording, without labels, and what is likely wrong with it.

    Frames are decoded when they are read, best in their order.

    Args:
        open_bag: function that returns the recording.
        every: take the first of so many frames.

    Raises:
        InputError: the recording has no complete frame, or as `Bag`. One that is damaged later on has those before.
        OSError: it cannot be opened.
    """
    recording = _Recording(open_bag, every)
    sources: list[FrameSource] = []
    try:
        for number, frame in enumerate(recording.frames()):
            sources.append(FrameSource(frame.name, functools.partial(recording.read, number)))
    except InputError as error:
        if not sources:
            raise
        recording.notes.append(str(error))
    return sources, recording.notes


def _frames(bag: Bag, every: int) -> Iterator[RecordedFrame]:
    """Open the recording and yield every `every`-th frame; the recording is closed with the iterator."""
    with bag:
        yield from itertools.islice(bag.frames(), 0, None, every)


class _Recording:
    """Reads frames by their number; a number below the last one starts from the beginning."""

    def __init__(self, open_bag: Callable[[], Bag], every: int) -> None:
        self._open, self._every = open_bag, every
        self._numbered: Iterator[tuple[int, RecordedFrame]] = iter(())
        self._last: tuple[int, RecordedFrame] | None = None
        self.notes: list[str] = []

    def frames(self) -> Iterator[RecordedFrame]:
        bag = self._open()
        self.notes = bag.notes
        return _frames(bag, self._every)

    def read(self, number: int) -> RGBDFrame:
        if self._last is None or self._last[0] > number:
            self._last, self._numbered = None, enumerate(self.frames())
        while self._last is None or self._last[0] < number:
            self._last = next(self._numbered)
        return self._last[1].read()
