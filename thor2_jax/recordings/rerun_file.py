"""Recordings for the Rerun viewer with frames and detections (extra `rerun`).

with RerunFile(Path("answers.rrd")) as file:
    file.write(frame, detections, name="000001")
"""

import contextlib
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thor2_jax.errors import InputError, needs_extra
from thor2_jax.files import check_output_file, errors_name, temporary_directory
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.frames.overlay import answer_paints
from thor2_jax.model.recognition import Detection

__all__ = ["RerunFile"]

_JPEG_QUALITY = 85

_APPLICATION = "thor2"

_MAX_CLASS = 2**16 - 1
"""Largest label number of a segmentation image of Rerun."""


class RerunFile:
    """An .rrd file that is being written.

    It has the colour and depth images, the labels and the boxes of the instances below `camera`, and the positions of
    the objects in `objects`. It appears when the context ends, also with an exception, if at least one frame was
    written, and then replaces an older one.

    Attributes:
        path: the file.
        n_frames: frames written.
    """

    def __init__(self, path: Path) -> None:
        """Check that `path` can be written.

        Raises:
            InputError: its suffix is not .rrd, it is a recording of another program, or rerun-sdk is missing.
            OSError: its folder does not exist or cannot be written.
        """
        if path.suffix != ".rrd" or path.is_dir():
            raise InputError(f"rerun is {path}; expected a file with the suffix .rrd")
        with errors_name(path), tempfile.TemporaryFile(dir=path.absolute().parent):
            pass
        check_output_file("rerun", path, _is_own)
        with needs_extra(f"rerun is {path}, which", "rerun-sdk", "rerun"):
            import rerun
        self._rerun: Any = rerun
        self.path, self.n_frames, self._folder = path, 0, contextlib.ExitStack()

    def __enter__(self) -> "RerunFile":
        """Create a temporary file beside `path`."""
        parent = self.path.absolute().parent
        with errors_name(self.path):
            self._temporary = self._folder.enter_context(temporary_directory(parent)) / self.path.name
        self._recording = self._rerun.RecordingStream(_APPLICATION)
        self._recording.save(self._temporary)
        # Camera coordinates, as those of OpenCV: x right, y down, z forward.
        self._recording.log("/", self._rerun.ViewCoordinates.RDF, static=True)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file and move it to `path`, or remove it if it is empty."""
        with self._folder, errors_name(self.path):
            self._recording.flush()
            self._recording.disconnect()
            if self.n_frames:
                self._temporary.chmod(0o644)
                self._temporary.replace(self.path)

    def write(self, frame: RGBDFrame, detections: Sequence[Detection], *, name: str, stamp: int | None = None) -> None:
        """Write a frame with labels and its detections.

        Lens distortion is not written: Rerun's camera has none.

        Args:
            frame: the frame.
            detections: of the frame.
            name: its name.
            stamp: its time, nanoseconds; None if it is unknown.
        """
        rerun, log = self._rerun, self._recording.log
        self._recording.set_time("frame", sequence=self.n_frames)
        if stamp is not None:
            self._recording.set_time("time", timestamp=np.datetime64(stamp, "ns"))
        camera = frame.intrinsics
        height, width = frame.depth.shape
        pinhole = rerun.Pinhole(
            focal_length=(camera.fx, camera.fy), principal_point=(camera.cx, camera.cy), width=width, height=height
        )
        log("camera", pinhole)
        log("camera/name", rerun.TextDocument(name))
        log("camera/color", rerun.Image(frame.color).compress(jpeg_quality=_JPEG_QUALITY))
        log("camera/depth", rerun.DepthImage(frame.depth_m, meter=1.0))
        if frame.label_image.max() <= _MAX_CLASS:
            log("camera/labels", rerun.SegmentationImage(frame.label_image.astype(np.uint16)))
        labels = [_label(one) for one in detections]
        colors = answer_paints([one.recognition for one in detections])
        boxes = np.array([one.box for one in detections], np.float32).reshape(-1, 4)
        log("camera/boxes", rerun.Boxes2D(mins=boxes[:, :2], sizes=boxes[:, 2:], labels=labels, colors=colors))
        placed = [(one.position, i) for i, one in enumerate(detections) if one.position is not None]
        points = rerun.Points3D(
            np.array([position for position, _ in placed], np.float32).reshape(-1, 3),
            labels=[labels[i] for _, i in placed],
            colors=[colors[i] for _, i in placed],
            radii=0.01,
        )
        log("objects", points)
        self.n_frames += 1


def _is_own(path: Path) -> bool:
    """Return whether a file is a recording of this software: its head names the application."""
    with path.open("rb") as file:
        head = file.read(4096)
    return head.startswith(b"RRF") and _APPLICATION.encode() in head


def _label(detection: Detection) -> str:
    answer = detection.recognition
    confidence = "" if answer.confidence is None else f" {answer.confidence:.2f}"
    return f"{answer.name or 'unknown'}{confidence}"
