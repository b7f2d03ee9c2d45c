"""The frames of a recording as sources that can be read again, one after the other."""

import functools
import itertools
from collections.abc import Callable, Iterator

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.recordings.bags import Bag
from thor2_jax.recordings.recorded_frames import RecordedFrame
from training.readers.frame_files import FrameSource

__all__ = ["recorded_sources"]


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
