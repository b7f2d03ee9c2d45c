"""What can be set when the service starts, and the limits that hold for every request."""

import dataclasses
from pathlib import Path

from thor2_jax.capacity import BATCH_BUCKETS
from thor2_jax.errors import InputError

__all__ = [
    "FARTHEST",
    "MAX_BODY",
    "MAX_CLOUDS",
    "MAX_DETAILED",
    "MAX_INSTANCES",
    "MAX_PIXELS",
    "MAX_RUNS",
    "MAX_TEXT",
    "Settings",
]

FARTHEST = 100.0
"""Metres: largest coordinate of a cloud."""

MAX_BODY = 16 * 2**20
"""Bytes of a request's body, and of the arrays that it unpacks to."""

MAX_PIXELS = 1920 * 1080
"""Pixels of an image."""

MAX_INSTANCES = 256
"""Instances in a frame."""

MAX_DETAILED = 32
"""Instances of a frame that are explained."""

MAX_RUNS = 50_000
"""Runs in the label map of an explained frame."""

MAX_CLOUDS = 32
"""Clouds in a request."""

MAX_TEXT = 4096
"""Bytes of the intrinsics."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """How a process of the service works.

    Attributes:
        model: run folder.
        token: callers must send `Authorization: Bearer TOKEN`; None lets everybody in.
        queue: requests that are worked on or wait at one time; more get a 429.
        deadline: seconds from a request's arrival to its answer; later it gets a 504.
        max_batch: largest batch on the device, one of `capacity.BATCH_BUCKETS`.
        window: seconds that a batch waits for the instances of requests that are being prepared.
        processes: that decode images and make clouds.
        unknown_below: confidence that an answer needs to have a name, as in `Recognizer`.
        cache: folder for compiled programs, so that the next start need not compile; None keeps none.

    Raises:
        InputError: a value out of its range.
    """

    model: Path
    token: str | None = None
    queue: int = 32
    deadline: float = 5.0
    max_batch: int = 32
    window: float = 0.01
    processes: int = 2
    unknown_below: float = 0.0
    cache: Path | None = None

    def __post_init__(self) -> None:
        for name in ("queue", "deadline", "processes"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} is {getattr(self, name)}; it must be positive")
        if self.max_batch not in BATCH_BUCKETS:
            raise InputError(f"max_batch is {self.max_batch}; expected one of {', '.join(map(str, BATCH_BUCKETS))}")
        if self.token is not None and not (self.token and self.token.isascii() and self.token.isprintable()):
            raise InputError("token must be printable ASCII characters, at least one")
