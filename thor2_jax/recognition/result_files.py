"""Files with the recognitions of one frame."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from thor2_jax.files import write_text
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.overlay import draw_overlay
from thor2_jax.recognition.recognizer import Recognition

__all__ = ["write_recognitions"]


def write_recognitions(out: Path, frame: RGBDFrame, recognitions: Sequence[Recognition]) -> None:
    """Write `recognition.json`, one object per instance, and `overlay.png` to a directory; create it if necessary.

    Raises:
        OSError: A file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    draw_overlay(frame.color, frame.labels, recognitions, out / "overlay.png")
    rows = [dataclasses.asdict(recognition) for recognition in recognitions]
    write_text(out / "recognition.json", json.dumps(rows, indent=1) + "\n")
