"""UW-IS Occluded (Samani and Banerjee, 2023): videos of cluttered tables in a warehouse and a lounge.

`<video>/images/<frame>_{rgb,depth,labels}.png` and `<frame>_poses.yaml`; 1280 x 720, depth in millimetres.
"""

from collections.abc import Iterator
from pathlib import Path

from thor2_jax.errors import InputError, decoding
from thor2_jax.files import read_table
from thor2_jax.frames.frames import Intrinsics, RGBDFrame, read_color, read_depth, read_labels
from training.readers.labelled import LabelledFrames, named_labels, sequence_of

__all__ = ["INTRINSICS", "NOT_SCORED", "UWISOccluded", "video_attributes"]

INTRINSICS = Intrinsics(920.458618164062, 921.807800292969, 626.486083984375, 358.848205566406, width=1280, height=720)
"""The camera of all videos."""

NOT_SCORED = frozenset({"ice_cream", "hot_sauce", "chips_can"})
"""Objects of the dataset that the paper does not score."""

_FIRST_LOUNGE = 167

_VIDEOS = {
    ("kitchen", "1"): ((41, 42, 176, 177), (44, 45, 179, 180), (46, 48, 182, 183)),
    ("food", "1"): ((32, 33, 167, 168), (35, 36, 170, 171), (38, 39, 173, 174)),
    ("tools", "1"): ((50, 51, 185, 186), (53, 54, 188, 189), (56, 57, 191, 192)),
    ("kitchen", "2"): ((68, 69, 203, 204), (71, 72, 206, 207), (74, 75, 209, 210)),
    ("food", "2"): ((77, 78, 212, 213), (80, 81, 215, 216), (83, 84, 218, 219)),
    ("tools", "2"): ((59, 60, 194, 195), (62, 63, 197, 198), (65, 66, 200, 201)),
}
"""The dataset's table: object category and light -> videos with no occlusion, low occlusion and high occlusion."""


def video_attributes(number: int) -> dict[str, str]:
    """Return the environment of a video and, if it is in the dataset's table, object category, occlusion and light."""
    attributes = {"environment": "lounge" if number >= _FIRST_LOUNGE else "warehouse"}
    for (category, light), columns in _VIDEOS.items():
        for occlusion, numbers in zip(("none", "low", "high"), columns, strict=True):
            if number in numbers:
                attributes |= {"category": category, "occlusion": occlusion, "light": light}
    return attributes


class UWISOccluded(LabelledFrames):
    """The frames of the dataset or of a part of it, by video and frame number."""

    def __init__(self, path: str | Path) -> None:
        """Find the frames.

        Raises:
            InputError: the folder holds no frame.
        """
        path = self.dataset_folder(path)
        videos = sorted((f for f in path.iterdir() if f.name.isdecimal()), key=lambda f: int(f.name))
        self.sources = [color for video in videos for color in sorted((video / "images").glob("*_rgb.png"))]
        if not self.sources:
            raise InputError(f"dataset: {path} has no <video number>/images/<frame>_rgb.png")
        self.identifiers = [f"{color.parents[1].name}/{_stem(color)}" for color in self.sources]

    def read(self, number: int) -> tuple[RGBDFrame, dict[int, str], dict[str, str]]:
        """Read a frame, its names and the attributes of its video."""
        color, depth, labels, poses = self.files(number)
        frame = RGBDFrame(read_color(color), read_depth(depth), read_labels(labels), INTRINSICS)
        return frame, _truth(poses), video_attributes(int(sequence_of(self.identifiers[number])))

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame."""
        color = self.sources[number]
        names = "rgb.png", "depth.png", "labels.png", "poses.yaml"
        return [color.with_name(f"{_stem(color)}_{name}") for name in names]

    def names(self) -> Iterator[str]:
        """Yield the names of the objects in all frames, frame by frame."""
        for number in range(len(self)):
            yield from _truth(self.files(number)[-1]).values()


def _stem(color: Path) -> str:
    return color.name.removesuffix("_rgb.png")


def _truth(path: Path) -> dict[int, str]:
    objects = read_table(path)
    with decoding(f"{path} does not hold the objects of a frame", "<name>: {label: <number>, ...}"):
        entries = [(entry["label"], name) for name, entry in objects.items() if name not in NOT_SCORED]
    return named_labels(path, entries)
