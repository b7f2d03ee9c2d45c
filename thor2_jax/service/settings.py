"""Settings of the service."""

import dataclasses
import importlib.util
from pathlib import Path

from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.errors import InputError, refusing_os_errors
from thor2_jax.files import check_writable
from thor2_jax.segmentation.segmenters import TABLE, load_segmenter
from thor2_jax.service.hosts import check_host_names, check_token

__all__ = ["Settings", "default_segmenter"]

MAX_DEADLINE = 86_400
"""Largest deadline of a request, in seconds."""


def default_segmenter() -> str | None:
    """Return the default segmenter of a service: the built-in one if OpenCV is installed, otherwise None."""
    return TABLE if importlib.util.find_spec("cv2") else None


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of one process of the service.

    Attributes:
        model: run directory.
        token: token of `Authorization: Bearer TOKEN`, which callers must send; None disables authentication.
        queue: largest number of requests in progress; further requests receive status 429.
        deadline: largest number of seconds from the arrival of a request to its response; after it, the status is 504.
        max_batch: largest batch size, one of `capacity.BATCH_BUCKETS`.
        processes: number of processes that decode images and compute clouds.
        unknown_below: confidence below which an object is unknown, as in `Recognizer`; None is the run's own.
        cache: directory of compiled programs, which a later start reuses; None keeps the setting of JAX, which commands
            set to the user's cache directory.
        gallery: directory of the enrolled objects; None is `gallery` in the run directory.
        teach: whether callers may enroll and forget objects.
        adapt: whether the camera's colour transform is estimated from the latest frames and applied.
        segmenter: name of the segmenter of frames without labels, see `segmentation.segmenters`; None refuses
            them. Default: the result of `default_segmenter`.
        allow_host: names that the header Host may have, besides loopback names and the address of the connection.
        warm_why: whether explanations are compiled in the background after the start, or from the first request on.

    Raises:
        InputError: a value is out of range, the cache cannot be created, or the segmenter cannot be loaded.
    """

    model: Path
    token: str | None = None
    queue: int = 32
    deadline: float = 5.0
    max_batch: int = 32
    processes: int = 2
    unknown_below: float | None = None
    cache: Path | None = None
    gallery: Path | None = None
    teach: bool = False
    adapt: bool = False
    segmenter: str | None = dataclasses.field(default_factory=default_segmenter)
    allow_host: tuple[str, ...] = ()
    warm_why: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.deadline <= MAX_DEADLINE:
            raise InputError(f"deadline is {self.deadline}; expected a positive number, at most {MAX_DEADLINE} seconds")
        check_host_names(self.allow_host)
        if self.cache is not None and not self.cache.is_dir():  # one that exists can be read
            problem = f"cache is {self.cache}, which cannot be created"
            with refusing_os_errors(problem, "expected a directory, which may be new"):
                check_writable(self.cache)
        if self.segmenter is not None:
            load_segmenter(self.segmenter)  # Its errors are reported here once, not by every process.
        if self.max_batch not in BATCH_BUCKETS:
            raise InputError(f"max_batch is {self.max_batch}; expected one of {', '.join(map(str, BATCH_BUCKETS))}")
        check_token(self.token)
