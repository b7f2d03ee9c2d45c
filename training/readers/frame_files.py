"""Frames to recognize: folders with the files of one frame each, and BOP scenes."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.recognition.frames import RGBDFrame, read_frame
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from training.readers.bop import BOP

__all__ = ["FILE_NAMES", "FrameFiles", "FrameSource", "find_frames", "frame_files", "segmented_source"]

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
    """The files of a frame; the arguments of `read_frame`.

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
        return read_frame(
            color=self.color,
            depth=self.depth,
            labels=self.labels,
            intrinsics=self.intrinsics,
            depth_scale=depth_scale,
        )


@dataclasses.dataclass(frozen=True)
class FrameSource:
    """A frame that can be read.

    Attributes:
        name: its folder, or scene and image.
        read: function that returns the frame; raises InputError and OSError. Worker processes get it pickled.
    """

    name: str
    read: Callable[[], RGBDFrame]


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
    """Find the frames in folders, in the order of their names.

    Args:
        paths: folders of one frame, folders that hold such folders at any depth or links to them, and BOP splits or
            scenes.
        depth_scale: see `read_frame`; BOP scenes have their own.

    Raises:
        InputError: a path is no directory or holds no frame, or two frames have the same name.
    """
    sources: list[FrameSource] = []
    for path in paths:
        path = path.absolute()  # gives "." a name
        if not path.is_dir():
            raise InputError(f"frames: {path} is not a directory; expected a folder of frames")
        if any(path.glob("scene_camera.json")) or any(path.glob("*/scene_camera.json")):
            dataset = BOP(path)
            of_path = [
                FrameSource(name, functools.partial(_read_bop, dataset, k))
                for k, name in enumerate(dataset.identifiers)
            ]
        else:
            # "**" does not follow links to folders, "*" does.
            patterns = [pattern for name in FILE_NAMES["color"] for pattern in (f"**/{name}", f"*/{name}")]
            colors = [file for pattern in patterns for file in path.glob(pattern)]
            of_path = [
                FrameSource(_name(folder, path), functools.partial(frame_files(folder).read, depth_scale))
                for folder in sorted({file.parent for file in colors})
            ]
        if not of_path:
            raise InputError(f"frames: {path} has no {' or '.join(FILE_NAMES['color'])}; expected a folder of frames")
        sources += of_path
    names = [source.name for source in sources]
    repeated = sorted({name for name in names if names.count(name) > 1}) if len(set(names)) < len(names) else []
    if repeated:
        raise InputError(f"frames: two frames are called {repeated[0]}; give each folder once, or one that holds both")
    return sources


def segmented_source(source: FrameSource, segmenter: Segmenter) -> FrameSource:
    """Return a frame that is segmented when it is read; labels that it has are replaced."""
    return FrameSource(source.name, functools.partial(_read_segmented, source, segmenter))


def _read_segmented(source: FrameSource, segmenter: Segmenter) -> RGBDFrame:
    return segmented(source.read(), segmenter)


def _read_bop(dataset: BOP, number: int) -> RGBDFrame:
    return dataset[number].frame


def _name(folder: Path, path: Path) -> str:
    """Return the name of a frame: that of its folder, after those between `path` and it."""
    return folder.name if folder == path else folder.relative_to(path).as_posix()
