"""Frames to recognize: folders with the files of one frame each, BOP scenes and recordings.

The folder of a labelled frame contains color.png, depth.png, mask.png, intrinsics.json and labels.json. The images and
the intrinsics may also have the other names in `FILE_NAMES`.
"""

import collections
import dataclasses
import functools
import itertools
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError, decoding
from thor2_jax.files import parse_json, read_file
from thor2_jax.frames.frames import Intrinsics, RecordedFrame, RGBDFrame, read_frame
from thor2_jax.printable import first_names
from thor2_jax.recordings.bags import Bag
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from training.readers.bop import BOP
from training.readers.labelled import LabelledFrames, named_labels, named_path

__all__ = ["FrameFiles", "FrameFolder", "FrameSource", "find_frames", "recorded_sources", "segmented_source"]

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
"""Possible names for each file of a frame; the first existing file is read."""

_NUMBER = re.compile(r"(\d+)")


@dataclasses.dataclass(frozen=True)
class FrameFiles:
    """The files of a frame: the arguments of `read_frame`, and beside them possibly a labels.json with object names.

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
        """Read the frame; the arguments and errors are those of `read_frame`."""
        return read_frame(**vars(self), depth_scale=depth_scale)

    @property
    def names(self) -> Path:
        """The file with the names of the objects; it may not exist."""
        return (self.labels or self.color).with_name("labels.json")

    def read_names(self) -> dict[int, str]:
        """Read the names: label -> name of the object; raise InputError or OSError if they are unusable."""
        content = read_file(self.names)
        with decoding(f"{self.names} is invalid", '{"labels": {"<number>": "<name>", ...}}'):
            entries = [(int(label), name) for label, name in parse_json(content)["labels"].items()]
        return named_labels(self.names, entries)

    def source(self, name: str, depth_scale: float | None = None) -> "FrameSource":
        """Return these files as a frame to read."""
        return FrameSource(name, functools.partial(self.read, depth_scale), self)


@dataclasses.dataclass(frozen=True)
class FrameSource:
    """A frame that can be read.

    Attributes:
        name: folder of the frame, or scene and image.
        read: function that returns the frame; raises InputError and OSError. It is pickled for worker processes.
        files: files of the frame; None for segmented frames and for frames of a BOP scene or a recording.
        unsegmented: the frame before it is segmented; None for frames that are read with their own labels.
    """

    name: str
    read: Callable[[], RGBDFrame]
    files: FrameFiles | None = None
    unsegmented: "FrameSource | RecordedFrame | None" = None


def frame_files(folder: Path) -> FrameFiles:
    """Return the files of the frame in a folder.

    A missing file gets the first of its possible names; a missing label image is None.
    """
    files: dict[str, Any] = {}
    for kind, names in FILE_NAMES.items():
        default = None if kind == "labels" else folder / names[0]
        files[kind] = next((folder / name for name in names if (folder / name).is_file()), default)
    return FrameFiles(**files)


def find_frames(paths: Sequence[Path], depth_scale: float | None = None) -> list[FrameSource]:
    """Find the frames in folders and return them in the order of their names, 2 before 10; the names are unique.

    Args:
        paths: frame folders, folders that contain frame folders or links to them, at any depth, and BOP splits or
            scenes. A frame with several names in a folder counts once.
        depth_scale: see `read_frame`.

    Raises:
        InputError: a path is not a directory or contains no frame, a frame is given twice, or `depth_scale` is out of
            range.
    """
    Intrinsics(1.0, 1.0, 0.0, 0.0).with_depth_scale(depth_scale)  # raises once, not for every frame
    located: list[tuple[Path, FrameSource]] = []  # folder of each frame, and the frame
    for path in paths:
        path = named_path(path)
        if not path.is_dir():
            raise InputError(f"frames: {path} is not a directory; expected a folder of frames")
        if any(path.glob("scene_camera.json")) or any(path.glob("*/scene_camera.json")):
            dataset = BOP(path)
            of_path = [
                (path / name, FrameSource(name, functools.partial(_read_bop, dataset.only(k), depth_scale)))
                for k, name in enumerate(dataset.identifiers)
            ]
        else:
            # A frame without colour is found, too, to report it. A link such as "latest" adds no frame a second time.
            images, of_path, visited = {*FILE_NAMES["color"], *FILE_NAMES["depth"]}, [], set[str]()
            for root, folders, files in os.walk(path, followlinks=True):
                folders.sort(key=lambda name: ([int(p) if p.isdecimal() else p for p in _NUMBER.split(name)], name))
                if (real := os.path.realpath(root)) in visited:
                    folders.clear()
                elif not images.isdisjoint(files):
                    folder = Path(root)
                    name = folder.name if folder == path else folder.relative_to(path).as_posix()
                    of_path.append((folder, frame_files(folder).source(name, depth_scale)))
                visited.add(real)
        if not of_path:
            raise InputError(f"frames: {path} has no {', '.join(FILE_NAMES['color'])}; expected frames or a BOP split")
        located += of_path
    sources = [source for _, source in located]
    counts = collections.Counter(folder.resolve() for folder, _ in located)
    if repeated := [folder for folder, count in counts.items() if count > 1]:
        raise InputError(f"frames: {repeated[0]} is given twice; give each folder once, or one that holds both")
    if len({source.name for source in sources}) == len(sources):
        return sources
    # Frames in different folders may have the same name: their names are then relative to the common parent folder.
    common = Path(os.path.commonpath([folder.parent for folder, _ in located]))
    names = [folder.relative_to(common).as_posix() for folder, _ in located]
    return [dataclasses.replace(source, name=name) for source, name in zip(sources, names, strict=True)]


class FrameFolder(LabelledFrames):
    """Frames, for instance of a folder, whose objects are named in a `labels.json` beside the label image.

    `labels.json` contains {"labels": {"1": "mug", ...}}; other entries are ignored.

    Attributes:
        named: whether the frames have names, each in a labels.json.
        note: the frames that are left out because they have no labels.json; empty if there are none.
    """

    def __init__(self, frames: str | Path | Sequence[FrameSource], *, named: bool | None = True) -> None:
        """Find the frames.

        Args:
            frames: a folder as for `find_frames`, or frames.
            named: whether a labels.json is required. If False and no frame has one, all frames are used without names;
                if None, they are even if some have one.

        Raises:
            InputError: the path is not a directory or contains no frame, or no frame has a labels.json.
        """
        sources = find_frames([Path(frames)]) if isinstance(frames, str | Path) else frames
        labelled = [each for each in sources if named is not None and each.files and each.files.names.is_file()]
        self.named = bool(labelled)
        if named and not self.named:
            names = first_names([each.name for each in sources])
            advice = "" if sources[0].files else "; `thor2 evaluate bop` reads the names of a BOP dataset"
            raise InputError(f"frames: {names}: no labels.json; expected the names of the objects{advice}")
        self.sources = labelled or sources
        self.identifiers = [source.name for source in self.sources]
        used = set(self.identifiers)
        left_out = [source.name for source in sources if source.name not in used]
        self.note = f"frames without labels.json: {len(left_out)} ({first_names(left_out)})" if left_out else ""

    def read(self, number: int) -> tuple[RGBDFrame, dict[int, str], dict[str, str]]:
        """Read a frame and the names in its labels.json, if it has one; there are no attributes."""
        source = self.sources[number]
        files = source.files
        if files is None or not self.named:
            return source.read(), {}, {}
        if files.labels is None:
            raise InputError(f"{files.color.with_name(FILE_NAMES['labels'][0])} is missing")
        frame, truth = source.read(), files.read_names()
        if truth and set(truth).isdisjoint(frame.instances):
            raise InputError(
                f"{files.names} has the labels {_listed(truth)}, but {files.labels} has only "
                f"{_listed(frame.instances)}; expected at least one in both: check that the files belong together"
            )
        return frame, truth, {}

    def names(self) -> set[str] | None:
        """Return the names of the objects in the labels.json of all frames."""
        files = [source.files for source in self.sources if source.files]
        return {name for each in files for name in each.read_names().values()} if self.named else None

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame; empty for a recording."""
        files = self.sources[number].files
        return [*filter(None, vars(files).values()), files.names] if files else []


def _listed(labels: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(labels))) or "background"


def segmented_source(source: FrameSource | RecordedFrame, segmenter: Segmenter) -> FrameSource:
    """Return a frame that is segmented when it is read; existing labels are replaced."""
    return FrameSource(source.name, functools.partial(_read_segmented, source, segmenter), unsegmented=source)


def _read_segmented(source: FrameSource | RecordedFrame, segmenter: Segmenter) -> RGBDFrame:
    return segmented(source.read(), segmenter)


def _read_bop(dataset: BOP, depth_scale: float | None) -> RGBDFrame:
    frame = dataset.read_frame(0)
    return dataclasses.replace(frame, intrinsics=frame.intrinsics.with_depth_scale(depth_scale))


def recorded_sources(open_bag: Callable[[], Bag], every: int = 1) -> tuple[list[FrameSource], list[str]]:
    """Return the frames of a recording, without labels, and notes about likely faults of the recording.

    Frames are decoded when they are read; this is fastest in their order.

    Args:
        open_bag: function that returns the recording.
        every: take every `every`-th frame.

    Raises:
        InputError: the recording has no complete frame; also as `Bag`. Frames before a later damage are returned.
        OSError: the recording cannot be opened.
    """
    bag, recording = open_bag(), _Recording(open_bag, every)
    sources: list[FrameSource] = []
    try:
        for number, frame in enumerate(_frames(bag, every)):
            sources.append(FrameSource(frame.name, functools.partial(recording.read, number)))
    except InputError as error:
        if not sources:
            raise
        return sources, [*bag.notes, str(error)]
    return sources, bag.notes


def _frames(bag: Bag, every: int) -> Iterator[RecordedFrame]:
    """Open the recording and yield every `every`-th frame; closing the iterator closes the recording."""
    with bag:  # no method of `_Recording`: a cycle of references would keep the recording open
        yield from itertools.islice(bag.frames(), 0, None, every)


class _Recording:
    """Reader of frames by number; it starts again from the beginning if a number is lower than the previous one."""

    def __init__(self, open_bag: Callable[[], Bag], every: int) -> None:
        self._open, self._every, self._number = open_bag, every, math.inf

    def read(self, number: int) -> RGBDFrame:
        if self._number > number:
            self._number = math.inf  # the next read repeats a start that fails
            self._numbered = enumerate(_frames(self._open(), self._every))
            self._number, self._frame = next(self._numbered)
        while self._number < number:
            self._number, self._frame = next(self._numbered)
        return self._frame.read()
