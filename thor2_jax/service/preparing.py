"""Decoding and cloud preparation in processes of their own.

They are most of a frame's work and hold the interpreter's lock, so threads would not help.

A process that takes too long over a request, or dies of it, is replaced; the service lives on.
"""

import dataclasses
import multiprocessing
import queue
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.recognition.prepared_instance import PreparedInstance, prepare_instance
from thor2_jax.service.decoding import clouds_of_json, clouds_of_npz, frame_of
from thor2_jax.service.problem import RequestError, late
from thor2_jax.service.schemas import LabelMap
from thor2_jax.service.settings import MAX_RUNS

__all__ = ["Prepared", "Preparers", "prepare_clouds", "prepare_frame"]

LEAST_TIME = 1.0
"""Seconds that a request has at least once a process has begun with it. Only what is far from usual is cut off."""


@dataclasses.dataclass(frozen=True, eq=False)
class Prepared:
    """What a process gives back: the instances, seconds a stage, and the frame's label map if it was asked for."""

    instances: list[PreparedInstance]
    seconds: dict[str, float]
    label_map: LabelMap | None = None


def prepare_frame(files: dict[str, bytes], sigma_s: float, with_map: bool) -> Prepared:
    """Decode a frame and make the clouds of its instances. Raises RequestError."""
    start = time.perf_counter()
    frame = frame_of(**files)
    decoded = time.perf_counter()
    try:
        instances = [prepare_instance(frame, label, sigma_s) for label in frame.instances]
    except InputError:  # images and numbers are right one by one: the camera puts the points out of all bounds
        raise RequestError(422, "intrinsics", "intrinsics put the points of an instance too far apart.") from None
    label_map = _label_map(frame.labels) if with_map else None
    return Prepared(instances, {"decode": decoded - start, "clouds": time.perf_counter() - decoded}, label_map)


def _label_map(labels: NDArray[Any]) -> LabelMap:
    step = 1
    while True:
        coarse = labels[::step, ::step]
        flat = coarse.ravel()
        starts = np.flatnonzero(np.diff(flat, prepend=~flat[0]))
        if len(starts) <= MAX_RUNS:
            height, width = coarse.shape
            lengths = np.diff(starts, append=flat.size)
            return LabelMap(width=width, height=height, labels=flat[starts].tolist(), lengths=lengths.tolist())
        step *= 2


def prepare_clouds(content: bytes, as_npz: bool) -> Prepared:
    """Clouds of a request's body, to be described as they are. Raises RequestError."""
    start = time.perf_counter()
    clouds = (clouds_of_npz if as_npz else clouds_of_json)(content)
    instances = [
        PreparedInstance(k, points, colors, np.zeros(len(points), bool)) for k, (points, colors) in enumerate(clouds)
    ]
    return Prepared(instances, {"decode": time.perf_counter() - start})


def _serve(pipe: Connection) -> None:
    """A process's life: a function and its arguments come in, (result, None) or (None, error) goes out."""
    for number in (signal.SIGINT, signal.SIGTERM):  # they go to all processes of a terminal; the service says when
        signal.signal(number, signal.SIG_IGN)
    pipe.send("ready")
    while True:
        try:
            function, arguments = pipe.recv()
        except EOFError:
            return
        answer: tuple[Any, Exception | None]
        try:
            answer = function(*arguments), None
        except RequestError as error:
            answer = None, error
        except Exception:
            answer = None, RuntimeError(traceback.format_exc())
        pipe.send(answer)


class _Process:
    def __init__(self, context: Any) -> None:
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        self.process.start()
        theirs.close()
        self.pipe.recv()

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


class Preparers:
    """A fixed number of processes, and a thread for each that waits for it."""

    def __init__(self, count: int) -> None:
        """Start `count` processes."""
        # From a server that holds the imported modules and no threads, so that a new process is there at once.
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__])
        self._threads = ThreadPoolExecutor(count, thread_name_prefix="prepare")
        self._idle: queue.SimpleQueue[_Process] = queue.SimpleQueue()
        for _ in range(count):
            self._idle.put(_Process(self._context))

    def submit(self, deadline: float, function: Callable[..., Prepared], *arguments: Any) -> Future[Prepared]:
        """Call `function` in a process; both it and the arguments are pickled.

        The future raises RequestError: the function's own, 504 if it is not done at `deadline` (`time.monotonic`), 422
        if the process died of it.
        """
        return self._threads.submit(self._call, deadline, function, arguments)

    def _call(self, deadline: float, function: Callable[..., Prepared], arguments: Sequence[Any]) -> Prepared:
        left = deadline - time.monotonic()
        if left <= 0:
            raise late()
        process = self._idle.get()
        try:
            if not process.process.is_alive():
                process = self._replaced(process)
            process.pipe.send((function, arguments))
            if not process.pipe.poll(max(left, LEAST_TIME)):
                process = self._replaced(process)
                raise late()
            answer, error = process.pipe.recv()
        except (EOFError, OSError):
            process = self._replaced(process)
            raise RequestError(422, "body", "What was sent could not be worked on in bounds.") from None
        finally:
            self._idle.put(process)
        if error is not None:
            raise error
        return answer

    def _replaced(self, process: _Process) -> _Process:
        process.stop()
        return _Process(self._context)

    def close(self) -> None:
        """Wait for the calls that were submitted, then end the processes."""
        self._threads.shutdown()
        while not self._idle.empty():
            self._idle.get().stop()
