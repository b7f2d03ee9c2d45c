"""Recognition of the frames of a recording, one after the other."""

import functools
import itertools
from collections.abc import Iterator

from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognizer import Recognizer
from thor2_jax.recordings.recorded_frames import RecordedFrame
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from training.frame_recognition import FrameAnswer, recognize_frames
from training.readers.frame_files import FrameSource

__all__ = ["recognize_recorded"]


def recognize_recorded(
    recognizer: Recognizer, frames: Iterator[RecordedFrame], segmenter: Segmenter, every: int = 1
) -> Iterator[tuple[RecordedFrame, FrameAnswer]]:
    """Segment and recognize recorded frames; one that fails has an `error` and does not stop the others.

    Args:
        recognizer: the recognizer.
        frames: the frames, without labels.
        segmenter: gives them labels.
        every: recognize the first of so many frames.

    Raises:
        InputError: as `frames`.
    """
    for recorded in itertools.islice(frames, 0, None, every):
        read = functools.partial(_read_segmented, recorded, segmenter)
        yield from ((recorded, answer) for answer in recognize_frames(recognizer, [FrameSource(recorded.name, read)]))


def _read_segmented(recorded: RecordedFrame, segmenter: Segmenter) -> RGBDFrame:
    return segmented(recorded.read(), segmenter)
