"""Worker processes that decode images and compute instance clouds.

Most of the work on a frame is done here. It holds the interpreter lock, so threads would not run in parallel. A process
that exceeds its deadline or crashes is replaced.
"""

import contextlib
import dataclasses
import functools
import multiprocessing
import queue
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance, instance_view, prepare_instance
from thor2_jax.segmentation.segmenters import load_segmenter, segmented
from thor2_jax.service.decoding import check_instances, decode_frame, decode_json_clouds, decode_npz_clouds
from thor2_jax.service.problem import RequestError, field_errors
from thor2_jax.service.schemas import LabelMap
from thor2_jax.signals import signals_blocked

__all__ = ["PreparationPool", "Prepare", "PreparedRequest", "prepare_clouds", "prepare_frame", "prepare_view", "timed"]

MAX_LABEL_RUNS = 50_000
"""Largest number of runs in the label map of an explained frame."""

MIN_SECONDS = 1.0
"""Shortest time that a process has for a request, so that only exceptionally slow requests are interrupted."""


@contextlib.contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Store the duration of the context in `seconds`, unless it raises."""
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedRequest:
    """A decoded request.

    Attributes:
        instances: the instances, in the order of their labels.
        seconds: stage -> duration.
        label_map: the label image of the frame, if it was requested or if the frame was segmented here.
        frame: the frame of a view, for the pictures of an explanation.
    """

    instances: list[PreparedInstance]
    seconds: dict[str, float]
    label_map: LabelMap | None = None
    frame: RGBDFrame | None = None


Prepare = Callable[..., PreparedRequest]
"""A function such as `prepare_frame`; it and its arguments are pickled."""


def prepare_frame(
    files: dict[str, bytes], config: DescriptorConfig, with_label_map: bool, segmenter: str | None
) -> PreparedRequest:
    """Decode a frame, segment it if it has no labels, and compute the clouds of its instances.

    Raises:
        RequestError: 422 if there are no labels and no segmenter, 500 if the segmenter fails; also as `decode_frame`.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "decode"):
        frame = decode_frame(**files)
    if frame.labels is None:
        with timed(seconds, "segment"):
            frame = _segmented(frame, segmenter)
        with_label_map = True
    with timed(seconds, "clouds"), field_errors():
        instances = [prepare_instance(frame, k, config.sigma_s) for k in frame.instances]
        label_map = _encode_label_map(frame.label_image) if with_label_map else None
    return PreparedRequest(instances, seconds, label_map)


_segmenter = functools.cache(load_segmenter)
"""Function that returns the segmenter with a name, which is loaded once in each process."""


def _segmented(frame: RGBDFrame, name: str | None) -> RGBDFrame:
    if name is None:
        raise RequestError(422, "labels", "labels is missing; this service has no segmenter (thor2 serve --segment).")
    try:
        frame = segmented(frame, _segmenter(name))
    except InputError as error:
        raise RequestError(500, "labels", f"{error}, or send labels.") from None
    check_instances(frame)
    return frame


def _warm_up(name: str) -> None:
    """Load a segmenter and segment a small frame, since a segmenter may load weights at its first frame.

    If this fails, requests report the reason.
    """
    blank = RGBDFrame(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint16), None, Intrinsics(60, 60, 32, 24))
    with contextlib.suppress(InputError):
        segmented(blank, _segmenter(name))


def prepare_view(fields: dict[str, Any], config: DescriptorConfig) -> PreparedRequest:
    """Decode a frame and compute the cloud of its instance `fields["instance"]` for enrollment or explanation.

    Raises:
        RequestError: 422 if there is no such instance or it has too few points; also as `prepare_frame`.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "decode"):
        frame = decode_frame(**{name: fields[name] for name in ("color", "depth", "intrinsics", "labels")})
    with timed(seconds, "clouds"), field_errors():
        view = instance_view(frame, fields["instance"], config.sigma_s)
    return PreparedRequest([view], seconds, frame=frame)


def _encode_label_map(labels: NDArray[Any]) -> LabelMap:
    flat = labels.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=~flat[0]))
    if len(starts) > MAX_LABEL_RUNS:
        return _encode_label_map(labels[::2, ::2])
    height, width = labels.shape
    lengths = np.diff(starts, append=flat.size)
    return LabelMap(width=width, height=height, labels=flat[starts].tolist(), lengths=lengths.tolist())


def prepare_clouds(content: bytes, is_npz: bool) -> PreparedRequest:
    """Decode the clouds of a request body; raise RequestError if they are invalid."""
    seconds: dict[str, float] = {}
    with timed(seconds, "decode"):
        clouds = (decode_npz_clouds if is_npz else decode_json_clouds)(content)
    instances = [PreparedInstance(k, *cloud, np.zeros(len(cloud[0]), bool)) for k, cloud in enumerate(clouds)]
    return PreparedRequest(instances, seconds)


def _run_process(pipe: Connection, segmenter: str | None) -> None:
    """Receive functions with their arguments, and send back (result, None) or (None, error)."""
    if segmenter is not None:
        _warm_up(segmenter)
    with contextlib.suppress(EOFError, OSError):  # The service has ended or was killed.
        pipe.send("ready")
        while True:
            function, arguments = pipe.recv()
            try:
                pipe.send((function(*arguments), None))
            except RequestError as error:
                pipe.send((None, error))
            except Exception:
                pipe.send((None, RuntimeError(traceback.format_exc())))


class _PreparationProcess:
    def __init__(self, context: Any, segmenter: str | None) -> None:
        self._context, self._segmenter = context, segmenter
        self.start()

    def start(self) -> None:
        self.pipe, child_pipe = self._context.Pipe()
        self.process = self._context.Process(target=_run_process, args=(child_pipe, self._segmenter), daemon=True)
        with signals_blocked(signal.SIGINT, signal.SIGTERM):  # A terminal signals all processes; `stop` ends this one.
            self.process.start()
        child_pipe.close()
        self.pipe.recv()

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def restart(self) -> None:
        self.stop()
        self.start()


class PreparationPool:
    """A fixed number of processes, each with a thread that waits for it."""

    def __init__(self, count: int, segmenter: str | None = None) -> None:
        """Start `count` processes, each of which loads the segmenter of this name."""
        # The fork server has imported this module and has no threads, so that a replacement process starts at once.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="prepare")
        self._idle: queue.SimpleQueue[_PreparationProcess] = queue.SimpleQueue()
        for _ in range(count):
            self._idle.put(_PreparationProcess(context, segmenter))

    def submit(self, deadline: float, function: Prepare, *arguments: Any) -> Future[PreparedRequest]:
        """Call `function` in a process.

        The future raises RequestError: the error of the function, 504 if the call has not returned at `deadline` (a
        time of `time.monotonic`), 422 if the process crashed.
        """
        return self._threads.submit(self._call, deadline, function, arguments)

    def _call(self, deadline: float, function: Prepare, arguments: Sequence[Any]) -> PreparedRequest:
        process, answer = self._idle.get(), None
        try:
            if not process.process.is_alive():
                process.restart()
            limit = max(deadline, time.monotonic() + MIN_SECONDS)
            # A process that was stopped by a signal does not receive, so that sending to it takes as long, too.
            timer = threading.Timer(limit - time.monotonic(), process.process.kill)
            timer.start()
            try:
                process.pipe.send((function, arguments))
                answer = process.pipe.recv()
            except (EOFError, OSError):
                pass  # The process has ended.
            finally:
                timer.cancel()
            if time.monotonic() >= limit:
                process.restart()
                raise RequestError(504)
            if answer is None:
                process.restart()
                raise RequestError(422, "body", "The body made the process that decoded it crash.")
        finally:
            self._idle.put(process)
        result, error = answer
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """Wait for submitted calls, then stop the processes."""
        self._threads.shutdown()
        while not self._idle.empty():
            self._idle.get().stop()
