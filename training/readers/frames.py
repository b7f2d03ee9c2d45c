"""Single labelled frames, a folder each: color.png, depth.png, mask.png, intrinsics.json, labels.json."""

import json
from collections.abc import Iterator
from pathlib import Path

from thor2_jax.errors import InputError
from thor2_jax.frames import read_frame
from training.readers.labelled import LabelledFrame

__all__ = ["FrameFolder"]


class FrameFolder:
    """The frames of a folder, or the one frame that it is; iterating reads one at a time.

    `labels.json` holds {"labels": {"1": "mug", ...}}; other entries are passed over.
    """

    def __init__(self, path: str | Path) -> None:
        """Finds the frames.

        Raises:
            InputError: there are none.
        """
        path = Path(path).absolute()  # so that every frame's folder has a name, that of "." too
        if not path.is_dir():
            raise InputError(f"dataset: {path} is no folder")
        self._folders = sorted(f.parent for f in [*path.glob("labels.json"), *path.glob("*/labels.json")])
        if not self._folders:
            raise InputError(f"dataset: {path} has no frame, neither labels.json nor */labels.json")

    def __len__(self) -> int:
        return len(self._folders)

    def __iter__(self) -> Iterator[LabelledFrame]:
        """Read the frames.

        Raises:
            InputError: a file that is missing or damaged, or images that do not fit together; names the file.
            OSError: a file cannot be opened.
        """
        for folder in self._folders:
            try:
                frame = read_frame(
                    color=folder / "color.png",
                    depth=folder / "depth.png",
                    labels=folder / "mask.png",
                    intrinsics=folder / "intrinsics.json",
                )
                truth = _truth(folder / "labels.json")
            except FileNotFoundError as error:
                raise InputError(f"{folder.name}: {error.filename} is missing") from None
            except InputError as error:
                raise InputError(f"{folder.name}: {error}") from None
            yield LabelledFrame(folder.name, frame, truth, {})


def _truth(path: Path) -> dict[int, str]:
    try:
        entries = [(int(label), name) for label, name in json.loads(path.read_bytes())["labels"].items()]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f'{path} does not hold {{"labels": {{"<number>": "<name>", ...}}}}') from None
    truth: dict[int, str] = {}
    for label, name in entries:
        if not isinstance(name, str):
            raise InputError(f"{path}: {name!r} is no object name")
        if label in truth:
            raise InputError(f"{path}: {truth[label]!r} and {name!r} have the label {label}")
        truth[label] = name
    return truth
