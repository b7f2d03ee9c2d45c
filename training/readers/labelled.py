"""Labelled frames, and the interface of all dataset readers."""

import abc
import copy
import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from thor2_jax.errors import InputError, with_context
from thor2_jax.frames.frames import RGBDFrame

__all__ = ["LabelledFrame", "LabelledFrames", "named_labels", "named_path", "path_ends", "sequence_of"]


def sequence_of(identifier: str) -> str:
    """Return the sequence of a frame: a/b/c for a/b/c/d."""
    return identifier.rpartition("/")[0]


def named_path(path: str | Path) -> Path:
    """Return the absolute path of a folder, so that its last part is a name, even for "." and "x/.."."""
    path = Path(path)
    return path.resolve() if ".." in path.parts else path.absolute()


def path_ends(sequence: str) -> list[str]:
    """Return the names by which a table may refer to a sequence a/b/c, longest first: a/b/c, b/c, c."""
    parts = sequence.split("/")
    return ["/".join(parts[start:]) for start in range(len(parts))]


def named_labels(path: Path, entries: Iterable[tuple[Any, Any]]) -> dict[int, str]:
    """Return label -> name; raise InputError with the path unless labels are integers with one name each."""
    names: dict[int, str] = {}
    for label, name in entries:
        if type(label) is not int or not (isinstance(name, str) and name.strip()):
            raise InputError(f"{path}: label {label!r} has the name {name!r}; expected an integer and a non-empty text")
        if label in names:
            raise InputError(f"{path}: label {label} has the names {names[label]!r} and {name!r}; expected one")
        names[label] = name
    return names


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledFrame:
    """A frame and the names of its objects.

    Attributes:
        identifier: name of the frame, unique in its dataset.
        frame: the images.
        truth: label number -> object name of the instances that are scored; an instance may have no pixels.
        attributes: conditions by which accuracy is reported, for instance {"occlusion": "high", "light": "1"}.
    """

    identifier: str
    frame: RGBDFrame
    truth: Mapping[int, str]
    attributes: Mapping[str, str]


class LabelledFrames(abc.ABC):
    """The frames of a dataset in a fixed order; a frame is read when it is indexed.

    A reader sets both attributes and implements `read`.

    Attributes:
        identifiers: identifiers of all frames, known without reading them.
        sources: source of each frame, for instance the path of its colour image.
    """

    identifiers: Sequence[str]
    sources: Sequence[Any]

    @staticmethod
    def dataset_folder(path: str | Path) -> Path:
        """Return the path of a dataset; raise InputError if it is not a directory."""
        path = Path(path)
        if not path.is_dir():
            raise InputError(f"dataset: {path} is not a directory; expected a dataset")
        return path

    def __len__(self) -> int:
        return len(self.identifiers)

    def __getitem__(self, number: int) -> LabelledFrame:
        """Read a frame.

        Raises:
            IndexError: `number` is out of range.
            InputError: a file is missing or damaged, or files do not belong together; the message names the frame and
                the file.
            OSError: a file cannot be opened.
        """
        identifier = self.identifiers[number]
        with with_context(identifier):
            return LabelledFrame(identifier, *self.read(number))

    @abc.abstractmethod
    def read(self, number: int) -> tuple[RGBDFrame, Mapping[int, str], Mapping[str, str]]:
        """Read the images, the names and the attributes of a frame, see `LabelledFrame`; raise errors as indexing."""

    def files(self, number: int) -> Sequence[Path]:
        """Return the files from which a frame is read; empty by default."""
        return ()

    def names(self) -> Iterable[str] | None:
        """Return the names of all objects, if they can be read without the images; by default they are unknown.

        The iteration may read files, and raises errors as indexing.
        """
        return None

    def only(self, number: int) -> Self:
        """Return a dataset with one of the frames, since sending all paths of a large dataset to a process is slow."""
        one = copy.copy(self)
        one.identifiers, one.sources = [self.identifiers[number]], [self.sources[number]]
        return one

    def __iter__(self) -> Iterator[LabelledFrame]:
        """Read the frames one at a time; raise errors as indexing."""
        return (self[number] for number in range(len(self)))
