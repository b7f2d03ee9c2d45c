"""Decoding of images and computation of instance clouds, in worker processes.

Most of the work on a frame is done here. It holds the interpreter lock, so threads would not run in parallel.
"""

import contextlib
import dataclasses
import functools
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import Intrinsics, RGBDFrame
from thor2_jax.frames.prepared_instance import PreparedInstance, instance_view, prepare_instance
from thor2_jax.processes import Processes
from thor2_jax.segmentation.segmenters import load_segmenter, segmented
from thor2_jax.service.decoding import decode_frame, decode_json_clouds, decode_npz_clouds
from thor2_jax.service.problem import RequestError, field_errors
from thor2_jax.service.schemas import LabelMap

__all__ = ["PreparedRequest", "prepare_clouds", "prepare_frame", "prepare_view", "start_processes", "timed"]

MAX_INSTANCES = 256
"""Largest number of instances in a frame."""

MAX_LABEL_RUNS = 50_000
"""Largest number of runs in the label map of an explained frame."""


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


def prepare_frame(
    files: dict[str, bytes], config: DescriptorConfig, with_label_map: bool, segmenter: str | None
) -> PreparedRequest:
    """Decode a frame, segment it if it has no labels, and compute the clouds of its instances.

    Raises:
        RequestError: 422 if there are no labels and no segmenter, or more than `MAX_INSTANCES` instances; 500 if the
            segmenter fails; also as `decode_frame`.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "decode"):
        frame = decode_frame(**files)
    if frame.labels is None:
        with timed(seconds, "segment"):
            frame = _segmented(frame, segmenter)
        with_label_map = True
    with timed(seconds, "clouds"), field_errors():
        _check_instances(frame)
        instances = [prepare_instance(frame, k, config.sigma_s) for k in frame.instances]
        label_map = _encode_label_map(frame.label_image) if with_label_map else None
    return PreparedRequest(instances, seconds, label_map)


def _check_instances(frame: RGBDFrame) -> None:
    if (count := len(frame.instances)) > MAX_INSTANCES:
        raise InputError(f"labels has {count} instances; expected at most {MAX_INSTANCES}")


_segmenter = functools.cache(load_segmenter)
"""Function that returns the segmenter with a name, which is loaded once in each process."""


def _segmented(frame: RGBDFrame, name: str | None) -> RGBDFrame:
    if name is None:
        raise RequestError(422, "labels", "labels is missing; this service has no segmenter (thor2 serve --segment).")
    try:
        return segmented(frame, _segmenter(name))
    except InputError as error:
        raise RequestError(500, "labels", f"{error}, or send labels.") from None


def _warm_up(name: str | None) -> None:
    """Load a segmenter and segment a small frame, since a segmenter may load weights at its first frame.

    If this fails, requests report the reason.
    """
    blank = RGBDFrame(np.zeros((48, 64, 3), np.uint8), np.zeros((48, 64), np.uint16), None, Intrinsics(60, 60, 32, 24))
    with contextlib.suppress(RequestError):  # also if there is no segmenter
        _segmented(blank, name)


def prepare_view(fields: dict[str, Any], config: DescriptorConfig) -> PreparedRequest:
    """Decode a frame and compute the cloud of its instance `fields["instance"]` for enrollment or explanation.

    Raises:
        RequestError: 422 if there is no such instance or it has too few points; also as `prepare_frame`.
    """
    seconds: dict[str, float] = {}
    with timed(seconds, "decode"):
        frame = decode_frame(**{name: fields[name] for name in ("color", "depth", "intrinsics", "labels")})
    with timed(seconds, "clouds"), field_errors():
        _check_instances(frame)
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


def start_processes(count: int, segmenter: str | None = None) -> Processes:
    """Start `count` processes that can call the functions of this module; each loads the segmenter of this name."""
    # The fork server has imported this module and has no threads, so that a replacement process starts at once.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    # A terminal signals all processes; `Processes.close` ends these.
    signals = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    processes = Processes(count, context, functools.partial(_warm_up, segmenter), *signals)
    for started in [processes.submit(os.getpid) for _ in range(count)]:
        started.result()
    return processes
