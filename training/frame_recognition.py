"""Recognition of several frames or of a recording, frame by frame.

for answer in recognize_frames(recognizer.recognize, find_frames([Path("frames")])):
    print(answer.name, answer.error or answer.recognitions)
"""

import dataclasses
import functools
import pickle
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

from numpy.typing import NDArray

from thor2_jax import Recognizer, TrackedRecognition
from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.errors import InputError, reason_of
from thor2_jax.frames.frames import MAX_DEPTH, MIN_DEPTH, RecordedFrame, RGBDFrame
from thor2_jax.frames.prepared_instance import unit_question
from thor2_jax.gallery.store import check_exists
from thor2_jax.model.recognition import Detection, Recognition, detections_as_json, detections_of
from training.readers.frames import FrameSource, segmented_source

__all__ = ["RecognizerArguments", "recognize_frames", "track_frames"]


@dataclasses.dataclass(frozen=True)
class FrameAnswer:
    """The answers for a frame, or the error that prevented them.

    Attributes:
        name: name of the frame.
        frame: the frame; None if it could not be read.
        recognitions: one answer for each instance.
        seconds: time for recognition, without the time to read the files.
        error: why the frame could not be recognized; None if it was.
        recorded: the frame's place in its recording; None if the frame is read from files.
    """

    name: str
    frame: RGBDFrame | None = None
    recognitions: Sequence[Recognition] = ()
    seconds: float = 0.0
    error: str | None = None
    recorded: RecordedFrame | None = None

    @functools.cached_property
    def detections(self) -> list[Detection]:
        """The answers with the positions of the objects; empty without a frame."""
        return [] if self.frame is None else detections_of(self.frame, self.recognitions)

    @property
    def segmentation_failure(self) -> str:
        """Why the frame has no instance if its depth is unusable, for segmented frames; otherwise an empty string."""
        if self.frame is None or self.recognitions or self.frame.has_usable_depth:
            return ""
        wanted = f"from {MIN_DEPTH} to {MAX_DEPTH} m"
        return f"segment: nothing was found, since no pixel has depth {wanted}: {unit_question(self.frame)}"

    def as_json(self) -> dict[str, Any]:
        """Return {"frame", "instances"} or {"frame", "error"}; recordings add "depth_gap", boxes and positions."""
        line: dict[str, Any] = {"frame": self.name}
        if self.recorded is not None:
            line["depth_gap"] = self.recorded.gap / 1e9
        if self.error is not None:
            return {**line, "error": self.error}
        if self.recorded is not None:
            return {**line, "instances": detections_as_json(self.detections)}
        return {**line, "instances": [dataclasses.asdict(answer) for answer in self.recognitions]}


def recognize_frames(
    recognize: Callable[[RGBDFrame], Sequence[Recognition]], sources: Iterable[FrameSource | RecordedFrame]
) -> Iterator[FrameAnswer]:
    """Read and recognize frames; a frame that fails has an `error` and does not stop the others.

    Args:
        recognize: `Recognizer.recognize`, or `Tracker.update`.
        sources: the frames, with labels. Errors of their iterator are raised.
    """
    for source in sources:
        recorded = source if isinstance(source, RecordedFrame) else None
        try:
            frame = source.read()
            start = time.perf_counter()
            recognitions = recognize(frame)
        except (InputError, OSError) as error:
            yield FrameAnswer(source.name, error=reason_of(error), recorded=recorded)
        else:
            yield FrameAnswer(source.name, frame, recognitions, time.perf_counter() - start, recorded=recorded)


@dataclasses.dataclass(frozen=True)
class RecognizerArguments:
    """The arguments of `Recognizer.load`, with which each worker process loads its recognizer."""

    model: Path
    unknown_below: float | None = None
    answer_by: str | None = None
    gallery: Path | None = None

    def load(self) -> Recognizer:
        """Load a recognizer for single frames.

        Raises:
            InputError: as `Recognizer.load`, the given gallery does not exist, or the model lacks the classifiers or
                enrolled objects to answer by.
        """
        check_exists(self.gallery)
        options: dict[str, Any] = {"gallery": self.gallery, "answer_by": self.answer_by, "chunk": BATCH_BUCKETS[-1]}
        recognizer = Recognizer.load(self.model, self.unknown_below, **options)
        if self.answer_by not in (None, "both", recognizer.model.answers_by()):
            missing = "enrolled objects; enroll" if self.answer_by == "gallery" else "classifiers; train"
            raise InputError(f"answer_by is {self.answer_by}, but the model has no {missing} some, or leave it out")
        return recognizer

    def segment(self, frame: RGBDFrame) -> NDArray[Any]:
        """Segment a frame with `Recognizer.segment` in a worker process, which loads the recognizer only once."""
        return _loaded(self).segment(frame)

    def answer(self, source: FrameSource) -> FrameAnswer:
        """Return the answer of `recognize_frames` for a frame, in a worker process like `segment`."""
        return next(recognize_frames(_loaded(self).recognize, [source]))


_loaded = functools.lru_cache(1)(RecognizerArguments.load)


def track_frames(
    recognizer: Recognizer, sources: Sequence[FrameSource], poses: Sequence[NDArray[Any] | None] | None = None
) -> Iterator[FrameAnswer]:
    """Read and recognize the frames of one camera as a sequence; the answers are fused over all frames.

    A frame that cannot be read, has no labels, or has another size than the first has an `error` and does not stop the
    others. The recognitions are `TrackedRecognition`s. All instances of a track have the name and confidence of the
    track after the last frame. An interrupt is raised after the answers so far are yielded.

    Args:
        recognizer: the recognizer.
        sources: the frames, in the order in which they were taken.
        poses: pose of the camera for each frame, see `thor2_jax.tracking.viewpoints`.
    """
    tracker = recognizer.track()
    answered: list[tuple[FrameAnswer, Sequence[TrackedRecognition], bytes]] = []
    last: dict[int | None, TrackedRecognition] = {}
    try:
        for source, pose in zip(sources, [None] * len(sources) if poses is None else poses, strict=True):
            (answer,) = recognize_frames(functools.partial(tracker.update, pose=pose), [source])
            tracked = cast(Sequence[TrackedRecognition], answer.recognitions)
            # A long sequence of images does not fit into memory; their labels do, which are slow to compute again.
            labels = zlib.compress(pickle.dumps(answer.frame and answer.frame.labels), 1)
            last |= {each.track: each for each in tracked}
            answered.append((dataclasses.replace(answer, frame=None), tracked, labels))
    finally:  # after an interrupt, too
        for source, (answer, tracked, labels) in zip(sources, answered, strict=False):
            final = [each if each.track is None else each.renamed(last[each.track]) for each in tracked]
            again = answer if answer.error is not None else _read_again(source, final, labels)
            yield dataclasses.replace(again, seconds=answer.seconds)


def _read_again(source: FrameSource, recognitions: Sequence[Recognition], labels: bytes) -> FrameAnswer:
    """Read a frame again, with these packed labels in place of its own, and return it with its recognitions."""
    labelled = segmented_source(source.unsegmented or source, lambda _: pickle.loads(zlib.decompress(labels)))
    return next(recognize_frames(lambda _: recognitions, [labelled]))
