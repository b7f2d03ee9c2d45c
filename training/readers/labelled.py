"""Frames with the truth about them, and what every reader of a dataset is."""

import abc
import dataclasses
from collections.abc import Iterator, Mapping, Sequence

from thor2_jax.recognition.frames import RGBDFrame

__all__ = ["LabelledFrame", "LabelledFrames", "path_ends", "sequence_of"]


def sequence_of(identifier: str) -> str:
    """The sequence a/b/c of the frame a/b/c/d."""
    return identifier.rpartition("/")[0]


def path_ends(sequence: str) -> list[str]:
    """What a sequence a/b/c may be called, the longest first: a/b/c, b/c, c."""
    parts = sequence.split("/")
    return ["/".join(parts[start:]) for start in range(len(parts))]


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledFrame:
    """What every reader yields.

    Attributes:
        identifier: names the frame within its dataset.
        frame: the images.
        truth: label number -> object name, of the instances that are scored. An instance may have no pixel in the label
            image.
        attributes: what accuracy is broken down by, for instance {"occlusion": "high", "light": "1"}.
    """

    identifier: str
    frame: RGBDFrame
    truth: Mapping[int, str]
    attributes: Mapping[str, str]


class LabelledFrames(abc.ABC):
    """The frames of a dataset, in an order that is always the same; each is read when it is asked for.

    Attributes:
        identifiers: of the frames, known without reading them.
    """

    identifiers: Sequence[str]

    def __len__(self) -> int:
        return len(self.identifiers)

    @abc.abstractmethod
    def __getitem__(self, number: int) -> LabelledFrame:
        """Read a frame.

        Raises:
            IndexError: there is none of that number.
            InputError: a file that is missing or damaged, or files that do not fit together; names the file.
            OSError: a file cannot be opened.
        """

    def __iter__(self) -> Iterator[LabelledFrame]:
        """Read them one at a time; raises as `[]`."""
        return (self[number] for number in range(len(self)))
