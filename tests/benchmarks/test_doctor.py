"""The benchmark of `thor2 doctor` on a rendered frame, whose objects a toy recognizer knows by their colours."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import thor2_jax
from benchmarks.doctor import DAMAGES, run
from thor2_jax.frames.frames import RGBDFrame
from thor2_jax.model.recognition import Recognition
from training.readers.frame_files import frame_files

SAMPLES = Path(thor2_jax.__file__).parent / "service" / "page" / "samples"


def recognizer_of(name: str) -> Any:
    """Return a recognizer that is the less sure the more the colours differ from those of a sample."""
    color = frame_files(SAMPLES / name).read().color.astype(float)

    def recognize(frame: RGBDFrame) -> list[Recognition]:
        confidence = float(np.exp(-20 * np.abs(frame.color - color).mean() / 255))
        return [Recognition(label, "known", confidence) for label in frame.instances]

    return SimpleNamespace(recognize=recognize, classes=("known",))


@pytest.mark.slow
def test_damaged_set_ups_are_diagnosed() -> None:
    assert len(DAMAGES) == 20
    report = run(SAMPLES, recognizer_of("clutter"), ["clutter"])
    wrong = {name: entry["found"] for name, entry in report["damaged"].items() if not entry["right"]}
    assert report["right_by_frame"]["clutter"] == 20 - len(wrong) and len(wrong) <= 2, wrong
