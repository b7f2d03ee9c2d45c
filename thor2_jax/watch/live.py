"""The loop of a live view: segment, recognize and draw each frame, and publish it as JSON.

A message has `state` (waiting, live, ended or failed), `message`, and the values of the last frame: `frame` (its name),
`number`, `image` (JPEG in base64), `fps`, `milliseconds` for segmentation and recognition, `error`, and `objects`:
name, confidence, track, frames, position, color and reason of each.
"""

import base64
import io
import json
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RecordedFrame, RGBDFrame
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, Annotation, Paint, draw_instances
from thor2_jax.model.recognition import Detection, Recognition, detections_of
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from thor2_jax.watch.server import Broadcast

__all__ = ["LiveView", "paced"]

FPS_FRAMES = 20
"""Frames over which the frame rate is averaged."""

LONGEST_PAUSE = 2.0
"""Longest time that a recording is late, or pauses, without a new start of its time, seconds."""

_JPEG_QUALITY = 80

_ANSWER_FIELDS = ("label", "name", "confidence", "occluded", "reason", "track", "frames")


def paced(
    frames: Iterable[RecordedFrame],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> Iterator[RecordedFrame]:
    """Yield the frames of a recording at the speed at which they were taken; those that are late are left out.

    Where a frame is more than `LONGEST_PAUSE` late or early, as while programs are compiled or after a gap in the
    recording, the time starts again with it.
    """
    offset: float | None = None  # of the clock to the time stamps
    for frame in frames:
        stamp, now = frame.stamp / 1e9, clock()
        if offset is None or abs(stamp + offset - now) > LONGEST_PAUSE:
            offset = now - stamp
        ahead = stamp + offset - now
        if ahead >= 0:
            sleep(ahead)
            yield frame


class LiveView:
    """Recognizes frames, one after the other, and publishes each.

    Attributes:
        n_frames: frames that were recognized.
    """

    def __init__(
        self, recognize: Callable[[RGBDFrame], Sequence[Recognition]], segmenter: Segmenter, broadcast: Broadcast
    ) -> None:
        """Publish that the first frame is awaited.

        Args:
            recognize: `Recognizer.recognize`, or `Tracker.update`, whose answers have tracks.
            segmenter: gives labels to the frames that have none.
            broadcast: receiver of the messages.
        """
        self._recognize, self._segmenter, self._broadcast = recognize, segmenter, broadcast
        self._times: deque[float] = deque(maxlen=FPS_FRAMES)
        self._last: dict[str, Any] = {}
        self.n_frames = 0
        self.publish_state("waiting", "Waiting for the first frame; the model is being compiled.")

    def publish_state(self, state: str, message: str) -> None:
        """Publish a state with the last frame."""
        self._broadcast.publish(json.dumps({**self._last, "state": state, "message": message}))

    def show(self, recorded: RecordedFrame) -> None:
        """Recognize and publish a frame; one that fails is published with its `error`."""
        start = time.perf_counter()
        values: dict[str, Any] = {"frame": recorded.name, "error": None, "objects": []}
        try:
            frame = recorded.read()
            if frame.labels is None:
                frame = segmented(frame, self._segmenter)
            recognitions = self._recognize(frame)
        except InputError as error:
            self._last = {**self._last, **values, "error": str(error)}
        else:
            milliseconds = 1000 * (time.perf_counter() - start)
            detections = sorted(detections_of(frame, recognitions), key=_order)
            annotations = [_annotation(one.recognition, number) for number, one in enumerate(detections)]
            values["objects"] = [_object(one, note.paint) for one, note in zip(detections, annotations, strict=True)]
            self._last = {**values, "milliseconds": milliseconds, "image": _picture(frame, annotations)}
            self.n_frames += 1
        self._times.append(time.perf_counter())
        steps = len(self._times) - 1
        fps = steps / (self._times[-1] - self._times[0]) if steps else None
        self._last |= {"number": self.n_frames, "fps": fps}
        self.publish_state("live", "")


def _order(detection: Detection) -> tuple[bool, int]:
    """Return the key by which detections are listed: named ones first, then by track or label."""
    answer = detection.recognition
    track = getattr(answer, "track", None)
    return answer.name is None, answer.label if track is None else track


def _annotation(answer: Recognition, number: int) -> Annotation:
    """Return the name and the colour of an instance, which is the same in all frames of a track."""
    if answer.name is None:
        return Annotation(answer.label, UNRECOGNIZED, "unknown")
    track = getattr(answer, "track", None)
    return Annotation(answer.label, COLORS[(number if track is None else track - 1) % len(COLORS)], answer.name)


def _object(detection: Detection, paint: Paint) -> dict[str, Any]:
    answer = detection.recognition
    return {
        **{name: getattr(answer, name, None) for name in _ANSWER_FIELDS},
        "position": detection.position,
        "color": "#{:02x}{:02x}{:02x}".format(*paint),
    }


def _picture(frame: RGBDFrame, annotations: Sequence[Annotation]) -> str:
    """Return the frame with its annotations, JPEG in base64."""
    stream = io.BytesIO()
    draw_instances(frame.color, frame.label_image, annotations).save(stream, "JPEG", quality=_JPEG_QUALITY)
    return base64.b64encode(stream.getvalue()).decode("ascii")
