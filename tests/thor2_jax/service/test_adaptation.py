"""A service that adapts to its camera, without HTTP."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import create_autospec

import numpy as np
import pytest
from helpers import slow

from thor2_jax.adaptation import estimate
from thor2_jax.adaptation.color_transform import ColorTransform
from thor2_jax.adaptation.estimate import EVERY, Adaptation, estimate_transform
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.service.answers import adaptation_answer
from thor2_jax.service.engine import InferenceEngine
from thor2_jax.service.settings import Settings

pytestmark = pytest.mark.usefixtures("small_buckets")


def views(count: int) -> list[PreparedInstance]:
    rng = np.random.default_rng(count)
    made = []
    for label in range(count):
        points = rng.uniform(0, (0.1, 0.06, 0.04), (100, 3)).astype(np.float32)
        colors = (rng.integers(20, 200, 3) + rng.integers(0, 40, (100, 3))).astype(np.uint8)
        made.append(PreparedInstance(label, points, colors, np.zeros(100, bool)))
    return made


def estimated(instances: Sequence[PreparedInstance], *_: object, **__: object) -> Adaptation:
    return Adaptation(ColorTransform(0.1, -0.1, 0.2, 0.05), len(instances), 1.0, 0.5)


@pytest.mark.parametrize("is_estimated", [False, *slow(True)])
def test_the_service_adapts_after_enough_instances(
    teaching_run: Path, is_estimated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not is_estimated:  # The tests of thor2_jax.adaptation estimate transforms.
        monkeypatch.setattr(estimate, "Objective", create_autospec(estimate.Objective))
        monkeypatch.setattr(estimate, "estimate_transform", create_autospec(estimate_transform, side_effect=estimated))
    engine = InferenceEngine(Settings(teaching_run, adapt=True))
    engine.compile_adaptation()
    first, second = views(EVERY - 1), views(3)
    unusable = dataclasses.replace(first[0], reason="too few points")
    for frame, observe in ((first, True), ([unusable], True), (second, False)):
        corrected = engine.correct(frame, observe=observe)
        assert all(a is b for a, b in zip(corrected, frame, strict=True))
    assert engine.adaptation is None and adaptation_answer(None) is None
    engine.correct(second, observe=True)
    assert engine._online is not None
    engine._online.join()
    adaptation = engine.adaptation
    assert adaptation is not None and adaptation.instances == EVERY + 2
    (corrected,) = engine.correct(second[:1], observe=False)
    np.testing.assert_array_equal(corrected.colors, adaptation.transform(second[0].colors))
    answer = adaptation_answer(adaptation)
    assert answer is not None
    assert answer.model_dump() == {"instances": EVERY + 2, **dataclasses.asdict(adaptation.transform)}


def test_a_service_does_not_adapt_by_default(teaching_run: Path) -> None:
    engine = InferenceEngine(Settings(teaching_run))
    engine.compile_adaptation()
    engine.correct(views(2 * EVERY), observe=True)
    assert engine.adaptation is None
