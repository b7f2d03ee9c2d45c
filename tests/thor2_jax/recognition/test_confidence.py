"""Confidence: its formula, damaged records, and what the recognizer makes of it."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from helpers import untrained_run

import thor2_jax as thor2
from thor2_jax.gallery.embedding import Embedding, EmbeddingSizes
from thor2_jax.recognition.confidence import Calibration, answer_features

FUSED = np.array([[0.7, 0.2, 0.1], [0.2, 0.2, 0.6]])
EMBEDDED = np.array([[0.4, 0.5, 0.0], [0.01, 0.0, 0.001]])
CALIBRATION = Calibration(-1.0, 0.5, 2.0, 0.25, 0.3, 0.6, 1.5)
RECORD = dataclasses.asdict(CALIBRATION)


def test_features_are_log_odds_of_answer_and_classes() -> None:
    expected = np.log([[0.7 / 0.3, 0.9 / 0.1], [0.6 / 0.4, 0.011 / 0.989]])
    np.testing.assert_allclose(answer_features(FUSED, EMBEDDED), expected)


def test_certain_answers_have_finite_features() -> None:
    features = answer_features(np.array([[1.0, 0.0]]), np.array([[0.0, 0.0]]))
    np.testing.assert_array_equal(features, [[8, -8]])


def test_the_largest_probability_is_the_confidence() -> None:
    correct = 1 / (1 + np.exp(1 - 0.5 * np.log(0.7 / 0.3)))
    known = 1 / (1 + np.exp(-2 - 0.25 * np.log(0.9 / 0.1)))
    score = correct * known
    confidence = 1 / (1 + np.exp(-0.6) * ((1 - score) / score) ** 1.5)
    values = CALIBRATION.calibrated(FUSED, EMBEDDED)
    np.testing.assert_allclose(values[0], np.array([1, 2 / 7, 1 / 7]) * confidence)
    np.testing.assert_array_equal(values.argmax(axis=1), FUSED.argmax(axis=1))
    assert values[1, 2] < values[0, 0]


def test_the_score_is_below_one() -> None:
    steep = dataclasses.replace(CALIBRATION, correct_factor=100.0, known_factor=100.0)
    score = steep.score(np.array([[1.0, 0.0]]), np.array([[1.0, 0.0]]))
    assert 0.999 < score[0] < 1


def test_records_without_a_third_function_are_read() -> None:
    record = {name: value for name, value in RECORD.items() if not name.startswith("score")}
    calibration = Calibration.of_record({"calibration": record})
    assert calibration is not None
    np.testing.assert_allclose(calibration.confidence(FUSED, EMBEDDED), CALIBRATION.score(FUSED, EMBEDDED))


@pytest.mark.parametrize(
    "record",
    [
        {"known_bias": 0.0},
        RECORD | {"unknown_below": 2.0},
        RECORD | {"known_bias": float("nan")},
        RECORD | {"known_bias": "0"},
        [],
    ],
)
def test_damaged_records_are_refused(record: Any) -> None:
    with pytest.raises(thor2.InputError, match="calibration"):
        Calibration.of_record({"calibration": record})
    assert Calibration.of_record({}) is None


def test_the_recognizer_uses_the_threshold_of_its_run() -> None:
    run = untrained_run(("a", "b", "c"), ("tops", "tops2"))
    record = {"calibration": RECORD}
    sizes = EmbeddingSizes(cell=4, hidden=(8,), learned=4, color=2)
    embedding = Embedding.create(run.config, run.network, sizes, classes=run.classes, distractors=2)
    recognizer = thor2.Recognizer(dataclasses.replace(run, record=record), embedding=embedding)
    assert recognizer.default_classifiers == ("tops", "tops2", "embedding")
    np.testing.assert_array_equal(recognizer.thresholds(), [0.3] * 3)
    np.testing.assert_array_equal(thor2.Recognizer(recognizer.run, 0.0).thresholds(), [0] * 3)
    np.testing.assert_array_equal(thor2.Recognizer(run, embedding=embedding).thresholds(), [0] * 3)
    probabilities = {"tops": FUSED, "tops2": FUSED, "embedding": EMBEDDED}
    np.testing.assert_allclose(recognizer.fused(probabilities), CALIBRATION.calibrated(FUSED, EMBEDDED))
    # The embedding of another run is no classifier.
    other = thor2.Recognizer(run, embedding=dataclasses.replace(embedding, classes=("a", "b")))
    assert other.default_classifiers == ("tops", "tops2")
