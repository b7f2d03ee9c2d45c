"""The Python code of docs/explain.md runs."""

from pathlib import Path

import numpy as np
import pytest
from doc_pages import python_blocks
from helpers import SMALL_CONFIG, untrained_run

import thor2_jax as thor2
from thor2_jax.explanation import class_scores

TEXT = (Path(__file__).parents[2] / "docs" / "explain.md").read_text()


@pytest.mark.slow
def test_the_code_explains_an_instance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(class_scores, "MIN_CAPACITY", 512)
    labels = np.zeros((90, 120), np.uint8)
    labels[20:70, 20:80] = 3
    depth = np.broadcast_to(600 + np.arange(120), labels.shape).astype(np.uint16)
    color = np.random.default_rng(0).integers(0, 256, (90, 120, 3), np.uint8)
    names = {
        "recognizer": thor2.Recognizer(untrained_run(("bowl", "mug"), config=SMALL_CONFIG)),
        "frame": thor2.RGBDFrame(color, depth, labels, thor2.Intrinsics(300.0, 300.0, 59.5, 44.5)),
    }
    (code,) = python_blocks(TEXT)
    exec(compile(code, "docs/explain.md", "exec"), names)
    assert {names["explanation"].name, names["explanation"].runner_up} == {"bowl", "mug"}
    assert names["picture"].name == "network"
