"""Frames of a RealSense camera (extra `realsense`).

    with RealSenseCamera() as camera:
        for recorded in camera.frames():
            frame = segmented(recorded.read())

Frames have no labels; `segmented` adds them.
"""

import contextlib
import functools
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from thor2_jax.errors import InputError, needs_extra, reason_of
from thor2_jax.frames.frames import RecordedFrame, RGBDFrame
from thor2_jax.frames.intrinsics import Intrinsics
from thor2_jax.recordings.messages import stamp_name

__all__ = ["RealSenseCamera"]

WIDTH, HEIGHT, RATE = 640, 480, 30
"""Size of both images, and frames per second; every RealSense camera with colour supports these."""


class RealSenseCamera:
    """A camera that is open inside its context; depth is aligned to colour."""

    def __init__(self, source: Any = None, timeout: float = 5.0) -> None:
        """Set the arguments; `__enter__` starts the camera.

        Args:
            source: source of frames, with `wait_for_frames(milliseconds)`: a started pipeline or a syncer of
                pyrealsense2. By default a pipeline of the first connected camera.
            timeout: seconds without a frame after which the camera counts as unplugged.
        """
        self._source, self._timeout = source, timeout
        self._pipeline: Any = None

    def __enter__(self) -> "RealSenseCamera":
        """Start the camera.

        Raises:
            InputError: the package pyrealsense2 is missing, or no camera is connected.
        """
        with needs_extra("realsense", "pyrealsense2 and the system library libusb-1.0-0", "realsense"):
            import pyrealsense2 as rs
        self._align: Any = rs.align(rs.stream.color)
        if self._source is None:
            config = rs.config()
            config.enable_stream(rs.stream.color, WIDTH, HEIGHT, rs.format.rgb8, RATE)
            config.enable_stream(rs.stream.depth, WIDTH, HEIGHT, rs.format.z16, RATE)
            pipeline = rs.pipeline()
            try:
                if not len(rs.context().query_devices()):  # `start` would wait for a device
                    raise RuntimeError("no device connected")
                pipeline.start(config)
            except RuntimeError as error:
                raise InputError(
                    f"realsense: no camera can be started ({error}); expected a RealSense camera with colour and "
                    f"depth of {WIDTH} x {HEIGHT} at {RATE} Hz; check the cable, and that no other program uses it"
                ) from None
            self._source = self._pipeline = pipeline
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the camera."""
        if self._pipeline is not None:
            with contextlib.suppress(RuntimeError):  # The camera may be unplugged.
                self._pipeline.stop()

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield the newest frame repeatedly.

        Raises:
            InputError: no frame arrives in time.
        """
        for n_frames in itertools.count():
            try:
                color, depth = self._next()
            except RuntimeError as error:
                raise InputError(
                    f"realsense: no frame for {self._timeout:g} s ({reason_of(error).rstrip('.')}; frames before: "
                    f"{n_frames}); the camera was unplugged or has stopped; check the cable"
                ) from None
            stamp = round(color.get_timestamp() * 1e6)
            gap = round(depth.get_timestamp() * 1e6) - stamp
            # The camera reuses the memory of its images.
            pixels, units = np.array(color.get_data(), np.uint8), np.array(depth.get_data(), np.uint16)
            read = functools.partial(RGBDFrame, pixels, units, None, _intrinsics(color, depth))
            yield RecordedFrame(stamp_name(stamp), read, stamp, gap)

    def _next(self) -> tuple[Any, Any]:
        """Return the next colour frame and the depth frame aligned to it; raise RuntimeError if none arrives."""
        for _ in range(max(int(self._timeout * RATE), 10)):
            frames = self._source.wait_for_frames(int(1000 * self._timeout))
            if frames.get_color_frame() and frames.get_depth_frame():
                aligned = self._align.process(frames)
                return aligned.get_color_frame(), aligned.get_depth_frame()
        raise RuntimeError("colour and depth do not arrive together")


def _intrinsics(color: Any, depth: Any) -> Intrinsics:
    camera = color.get_profile().as_video_stream_profile().get_intrinsics()
    names = ("fx", "fy", "ppx", "ppy", "width", "height", "model", "coeffs")
    values = {name: getattr(camera, name) for name in names}
    return Intrinsics.of({**values, "depth_scale": round(float(depth.get_units()), 9)})
