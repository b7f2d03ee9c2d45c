"""Recognition of the frames of a recording, one after the other."""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.model.answers import Recognition
from thor2_jax.recordings.recorded_frames import RecordedFrame
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from training.frame_recognition import FrameAnswer

__all__ = ["recognize_recorded"]


def recognize_recorded(
    recognize: Callable[[RGBDFrame], Sequence[Recognition]],
    frames: Iterator[RecordedFrame],
    segmenter: Segmenter,
    every: int = 1,
) -> Iterator[tuple[RecordedFrame, FrameAnswer]]:
    """Segment and recognize recorded frames; one that fails has an `error` and does not stop the others.

    Args:
        recognize: `Recognizer.recognize`, or `Tracker.update`.
        frames: the frames, without labels.
        segmenter: gives them labels.
        every: recognize the first of so many frames.

    Raises:
        InputError: as `frames`.
    """
    for recorded in itertools.islice(frames, 0, None, every):
        try:
            frame = segmented(recorded.read(), segmenter)
            start = time.perf_counter()
            recognitions = recognize(frame)
        except InputError as error:
            yield recorded, FrameAnswer(recorded.name, error=str(error))
        else:
            yield recorded, FrameAnswer(recorded.name, frame, recognitions, time.perf_counter() - start)
