"""Frames of a recording or a live camera, which are decoded when they are read."""

import dataclasses
from collections.abc import Callable

from thor2_jax.frames.frames import RGBDFrame

__all__ = ["RecordedFrame", "stamp_name"]


def stamp_name(stamp: int) -> str:
    """Return a time stamp in nanoseconds as text in seconds: the name of a recorded frame."""
    seconds, nanoseconds = divmod(abs(stamp), 10**9)
    return f"{'-' if stamp < 0 else ''}{seconds}.{nanoseconds:09d}"


@dataclasses.dataclass(frozen=True)
class RecordedFrame:
    """A frame that can be read.

    Attributes:
        name: unique: time stamp in seconds, with a number if several frames have it, or name of the folder.
        read: function that returns the frame, without labels in recordings; raises InputError and OSError.
        stamp: time of the colour image, nanoseconds.
        gap: time from the colour image to the depth image, nanoseconds.
        frame_id: coordinate frame of the colour camera in ROS.
    """

    name: str
    read: Callable[[], RGBDFrame]
    stamp: int
    gap: int = 0
    frame_id: str = ""
