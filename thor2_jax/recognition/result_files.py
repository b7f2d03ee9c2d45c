"""Files with the recognitions of one frame."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from thor2_jax.files import write_text
from thor2_jax.recognition.answers import Recognition
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.overlay import draw_overlay

__all__ = ["RESULT_FILES", "write_recognitions"]

RESULT_FILES = ("overlay.png", "recognition.json")


def write_recognitions(out: Path, frame: RGBDFrame, recognitions: Sequence[Recognition]) -> None:
    """Write `recognition.json`, one object per instance, and `overlay.png` to a directory; create it if necessary.

    Raises:
        OSError: A file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    draw_overlay(frame.color, frame.label_image, recognitions, out / RESULT_FILES[0])
    rows = [dataclasses.asdict(recognition) for recognition in recognitions]
    write_text(out / RESULT_FILES[1], json.dumps(rows, indent=1) + "\n")
