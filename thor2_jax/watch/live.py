"""The live view: a loop that recognizes each frame and publishes it, and the local web server of its page.

with serve_live(broadcast, port=0) as url:
    view = LiveView(recognizer.recognize, load_segmenter("table"), broadcast)
    for recorded in frames:
        view.show(recorded)

A message is JSON and a server-sent event. It has `state` (waiting, live, ended or failed), `message`, and the values of
the last frame: `frame` (its name), `number`, `image` (JPEG in base64), `fps`, `milliseconds` for segmentation and
recognition, `error`, and `objects`: the fields of the answer, box, position and color of each object. After an error,
`image` and `milliseconds` are those of the last recognized frame.
"""

import base64
import contextlib
import json
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError, reason_of
from thor2_jax.frames.frames import RecordedFrame, RGBDFrame, encode_image
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, Annotation, draw_instances
from thor2_jax.model.recognition import Detection, Recognition, detections_as_json, detections_of
from thor2_jax.segmentation.segmenters import Segmenter, segmented
from thor2_jax.service.hosts import check_host_names, is_allowed_host, listening, page_headers

__all__ = ["Broadcast", "LiveView", "paced", "serve_live"]

FPS_FRAMES = 20
"""Number of frames over which the frame rate is averaged."""

LONGEST_PAUSE = 2.0
"""Largest time, seconds, that a frame may be early before the clock of the recording is reset."""

_JPEG_QUALITY = 80


def paced(frames: Iterable[RecordedFrame]) -> Iterator[RecordedFrame]:
    """Yield the frames of a recording at the speed at which they were taken; late frames are skipped.

    The clock is reset to the second frame if it is late, since the first one waits until programs are compiled, and to
    any frame that is more than `LONGEST_PAUSE` early, or whose time stamp goes back, because the recording has a gap.
    """
    stamp = offset = -math.inf  # the offset is from the time stamps to the clock
    for number, frame in enumerate(frames):
        previous, stamp, now = stamp, frame.stamp / 1e9, time.monotonic()
        ahead = stamp + offset - now
        if (ahead < 0 and number < 2) or ahead > LONGEST_PAUSE or stamp < previous:
            offset, ahead = now - stamp, 0.0
        if ahead >= 0:
            time.sleep(ahead)
            yield frame


class Broadcast:
    """The latest message, for which threads can wait. Slow readers skip messages."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number, self._text = 0, ""

    def publish(self, text: str) -> None:
        """Replace the message."""
        with self._changed:
            self._number, self._text = self._number + 1, text
            self._changed.notify_all()

    def wait(self, after: int, timeout: float) -> tuple[int, str] | None:
        """Return the number and the text of a message later than number `after`; None at the timeout.

        Args:
            after: number of the last received message; 0 for none.
            timeout: seconds to wait.
        """
        with self._changed:
            is_later = self._changed.wait_for(lambda: self._number > after, timeout)
            return (self._number, self._text) if is_later else None


class LiveView:
    """A view that recognizes frames one after the other and publishes them.

    Attributes:
        n_frames: number of recognized frames.
        first_error: name and error of the first frame that could not be recognized; empty if there is none.
    """

    def __init__(
        self, recognize: Callable[[RGBDFrame], Sequence[Recognition]], segmenter: str | Segmenter, broadcast: Broadcast
    ) -> None:
        """Publish the state "waiting" for the first frame.

        Args:
            recognize: `Recognizer.recognize`, or `Tracker.update`, whose answers have tracks.
            segmenter: segmenter of frames without labels, or its name.
            broadcast: receiver of the messages.
        """
        self._recognize, self._segmenter, self._broadcast = recognize, segmenter, broadcast
        self._times: deque[float] = deque(maxlen=FPS_FRAMES)
        self._last: dict[str, Any] = {}
        self.n_frames, self.first_error = 0, ""
        self.publish_state("waiting", "Waiting for the first frame; the model is being compiled.")

    def publish_state(self, state: str, message: str) -> None:
        """Publish a state together with the last frame."""
        self._broadcast.publish(json.dumps({**self._last, "state": state, "message": message}))

    def show(self, recorded: RecordedFrame) -> None:
        """Recognize and publish a frame; if this fails, publish it with its `error`."""
        start = time.perf_counter()
        values: dict[str, Any] = {"frame": recorded.name, "error": None, "objects": []}
        try:
            frame = recorded.read()
            if frame.labels is None:
                frame = segmented(frame, self._segmenter)
            recognitions = self._recognize(frame)
        except (InputError, OSError) as error:
            self._last = {**self._last, **values, "error": reason_of(error)}
            self.first_error = self.first_error or f"{recorded.name}: {reason_of(error)}"
        else:
            milliseconds = 1000 * (time.perf_counter() - start)
            detections = sorted(detections_of(frame, recognitions), key=_order)
            annotations = [_annotation(one.recognition, number) for number, one in enumerate(detections)]
            values["objects"] = [
                {"track": None, **one, "color": "#{:02x}{:02x}{:02x}".format(*note.paint)}
                for one, note in zip(detections_as_json(detections), annotations, strict=True)
            ]
            picture = draw_instances(frame.color, frame.label_image, annotations)
            image = base64.b64encode(encode_image(picture, "JPEG", quality=_JPEG_QUALITY)).decode("ascii")
            self._last = {**values, "milliseconds": milliseconds, "image": image}
            self.n_frames += 1
        self._times.append(time.perf_counter())
        steps = len(self._times) - 1
        fps = steps / (self._times[-1] - self._times[0]) if steps else None
        self._last |= {"number": self.n_frames, "fps": fps}
        self.publish_state("live", "")


def _order(detection: Detection) -> tuple[bool, int]:
    """Return the sort key of a detection in the list: recognized objects first, then by track or label."""
    answer = detection.recognition
    return answer.name is None, getattr(answer, "track", None) or answer.label


def _annotation(answer: Recognition, number: int) -> Annotation:
    """Return the name and the colour of an instance, which is the same in all frames of a track."""
    if answer.name is None:
        return Annotation(answer.label, UNRECOGNIZED, "unknown")
    track = getattr(answer, "track", None)
    return Annotation(answer.label, COLORS[(number if track is None else track - 1) % len(COLORS)], answer.name)


_PAGE = Path(__file__).parent / "page"
_SERVICE_PAGE = Path(__file__).parents[1] / "service" / "page"

_FILES = {
    "/": (_PAGE / "index.html", "text/html; charset=utf-8"),
    "/watch.js": (_PAGE / "watch.js", "text/javascript; charset=utf-8"),
    "/watch.css": (_PAGE / "watch.css", "text/css; charset=utf-8"),
    "/style.css": (_SERVICE_PAGE / "style.css", "text/css; charset=utf-8"),
    "/icon.svg": (_SERVICE_PAGE / "icon.svg", "image/svg+xml"),
}
"""Path -> file and content type."""

_HEADERS = page_headers("'self' data:", "no-store")

KEEP_ALIVE = 2.0
"""Seconds without a message after which a comment is sent, so that a closed connection is noticed."""


class _Server(ThreadingHTTPServer):
    def __init__(self, listener: socket.socket, broadcast: Broadcast, allow_host: Sequence[str]) -> None:
        super().__init__(listener.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener
        self.broadcast, self.allow_host, self.is_stopping = broadcast, allow_host, threading.Event()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore errors of single connections, which the browser has closed."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = 30

    def do_GET(self) -> None:
        """Answer with a file, or with the messages of the live view."""
        address = self.connection.getsockname()[0]
        if not is_allowed_host(self.headers.get("Host", ""), address, self.server.allow_host):
            self.send_error(403, "Host is another server's; see --allow-host")
        elif self.path == "/events":
            self._send_events()
        elif self.path in _FILES:
            file, kind = _FILES[self.path]
            content = file.read_bytes()
            self._start(kind, {"Content-Length": str(len(content))})
            self.wfile.write(content)
        else:
            self.send_error(404)

    def _start(self, kind: str, headers: dict[str, str]) -> None:
        self.send_response(200)
        for name, value in {"Content-Type": kind, **_HEADERS, **headers}.items():
            self.send_header(name, value)
        self.end_headers()

    def _send_events(self) -> None:
        self._start("text/event-stream", {})
        number = 0
        while not self.server.is_stopping.is_set():
            message = self.server.broadcast.wait(number, KEEP_ALIVE)
            if message is None:
                self.wfile.write(b":\n\n")
            else:
                number, text = message
                self.wfile.write(f"data: {text}\n\n".encode())
            self.wfile.flush()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, since a page makes one request for each file."""


@contextlib.contextmanager
def serve_live(
    broadcast: Broadcast, host: str = "127.0.0.1", port: int = 8090, allow_host: Sequence[str] = ()
) -> Iterator[str]:
    """Serve a live view in threads of this process; yield its address.

    Args:
        broadcast: the messages.
        host: address to listen on.
        port: port to listen on; 0 chooses a free one.
        allow_host: names that the header Host may have, besides loopback names and the address of the connection.

    Raises:
        InputError: the address cannot be used, or a name is not a host name.
    """
    check_host_names(allow_host)
    with listening(host, port) as (listener, url), _Server(listener, broadcast, (*allow_host, host)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
        thread.start()
        try:
            yield url
        finally:
            server.is_stopping.set()
            server.shutdown()
            thread.join()
