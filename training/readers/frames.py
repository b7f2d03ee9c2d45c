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
        path = Path(path)
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
            InputError: a damaged file, or images that do not fit together; names the file.
            OSError: a file is missing.
        """
        for folder in self._folders:
            frame = read_frame(
                color=folder / "color.png",
                depth=folder / "depth.png",
                labels=folder / "mask.png",
                intrinsics=folder / "intrinsics.json",
            )
            yield LabelledFrame(folder.name, frame, _truth(folder / "labels.json"), {})


def _truth(path: Path) -> dict[int, str]:
    try:
        labels = json.loads(path.read_bytes())["labels"]
        truth = {int(label): name for label, name in labels.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise InputError(f'{path} does not hold {{"labels": {{"<number>": "<name>", ...}}}}') from None
    bad = [name for name in truth.values() if not isinstance(name, str)]
    if bad:
        raise InputError(f"{path}: {bad[0]!r} is no object name")
    return truth
