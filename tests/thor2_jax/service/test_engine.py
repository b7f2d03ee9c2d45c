"""The engine of the service, without HTTP: enrolled objects, an embedding alone, confidences, adaptation."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from unittest.mock import create_autospec

import numpy as np
import pytest
from refusals import assert_refused
from slow_tier import slow
from small_clouds import random_clouds
from small_runs import SMALL_CONFIG, assert_same_answers, untrained_embedding_run, with_surfaces

import thor2_jax as thor2
from thor2_jax.adaptation import estimate
from thor2_jax.adaptation.estimate import EVERY, Adaptation, estimate_transform
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances, prepare_instance
from thor2_jax.model.fusion import Calibration
from thor2_jax.model.inference import Inference
from thor2_jax.model.run_directory import save_run
from thor2_jax.service.answers import adaptation_answer, calibrated_confidence
from thor2_jax.service.engine import InferenceEngine, recognize
from thor2_jax.service.settings import Settings

from .conftest import write_run

BY_CLASSIFIERS: dict[str, object] = {"answer_by": "classifiers"}


@pytest.fixture(autouse=True)
def small_buckets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let batches, estimates and explanations have the padded size of small clouds, so that they share programs."""
    monkeypatch.setattr("thor2_jax.capacity.MIN_BATCH_POINTS", 512)
    monkeypatch.setattr(estimate, "CAPACITY", 512)


def check_answers(run: Path, frame: thor2.RGBDFrame) -> list[float | None]:
    """Compare the engine's answers with the recognizer's; return the calibrated confidences, which are the answers'."""
    engine, recognizer = InferenceEngine(Settings(run, max_batch=8)), thor2.Recognizer.load(run)
    instances = [prepare_instance(frame, label, engine.model.run.config.sigma_s) for label in frame.instances]
    usable = [instance for instance in instances if instance.reason is None]
    results = engine.infer(usable)
    answers = recognize(engine.model, instances, results)
    assert_same_answers(answers, recognizer.recognize(frame), 1e-4)
    assert engine.model.names == recognizer.classes
    assert {a.name for a in recognize(engine.model, [i for i in instances if i.reason is not None], [])} == {None}
    given = [answer for answer in answers if answer.confidence is not None]
    confidences = [
        calibrated_confidence(engine.model, answer, one.inference) for answer, one in zip(given, results, strict=True)
    ]
    assert all(c in (None, answer.confidence) for c, answer in zip(confidences, given, strict=True))
    return confidences


@pytest.mark.parametrize("trained", [("a", "b"), *slow(())])
@pytest.mark.parametrize("record", [{}, *slow(BY_CLASSIFIERS)])
def test_the_engine_answers_as_the_recognizer(
    trained: tuple[str, ...], record: dict[str, object], frame: thor2.RGBDFrame, tmp_path: Path
) -> None:
    recognizer = thor2.Recognizer.load(write_run(tmp_path / "run", trained, record))
    recognizer.enroll("tall", [(frame, 200)])
    recognizer.enroll("wide", [(frame, 7)])
    assert set(check_answers(tmp_path / "run", frame)) == {None}


@pytest.mark.parametrize("calibration", [None, Calibration(0.0, 1.0, 1.0, 0.5, 0.1)])
def test_an_embedding_alone_answers(calibration: Calibration | None, frame: thor2.RGBDFrame, tmp_path: Path) -> None:
    record: dict[str, object] = {} if calibration is None else {"calibration": dataclasses.asdict(calibration)}
    run = untrained_embedding_run(("a", "b", "c"), config=dataclasses.replace(SMALL_CONFIG, looks=2), record=record)
    save_run(with_surfaces(run) if calibration else run, tmp_path / "run")
    confidences = check_answers(tmp_path / "run", frame)
    assert all((given is None) == (calibration is None) for given in confidences)


def test_confidences_use_the_temperatures_of_both_classifiers(run_dir: Path) -> None:
    rng = np.random.default_rng(0)
    model = thor2.Recognizer.load(run_dir).model
    alpha = np.full(len(model.names), 0.1)
    probabilities = {name: rng.dirichlet(alpha).astype(np.float32) for name in ("tops", "tops2", "embedding")}
    recognition, inference = thor2.Recognition(1, confidence=0.5), Inference(0, probabilities)
    assert calibrated_confidence(model, recognition, inference) is None
    model.run.record["temperatures"] = {"tops": 2.0, "tops2": 3.0}
    confidence = calibrated_confidence(model, recognition, inference)
    logits = np.log(probabilities["tops"]) / 2 + np.log(probabilities["tops2"]) / 3
    expected = np.exp(logits / 2) / np.exp(logits / 2).sum()
    best = (probabilities["tops"] * probabilities["tops2"]).argmax()
    assert confidence == pytest.approx(expected[best], rel=1e-4)


def test_a_run_that_answers_by_classifiers_teaches_with_both(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", record=BY_CLASSIFIERS)
    assert InferenceEngine(Settings(run, teach=True)).model.answer_by == "both"


def views(count: int) -> list[PreparedInstance]:
    clouds = random_clouds(count, [100] * count)
    return [PreparedInstance(k, *cloud, np.zeros(100, bool)) for k, cloud in enumerate(clouds)]


def estimated(instances: Sequence[PreparedInstance], *_: object, **__: object) -> Adaptation:
    return Adaptation(thor2.ColorTransform(0.1, -0.1, 0.2, 0.05), len(instances), 1.0, 0.5)


@pytest.mark.parametrize("trained", [("a", "b"), ()])
@pytest.mark.parametrize("is_estimated", [False, *slow(True)])
def test_the_service_adapts_after_enough_instances_if_told(
    trained: tuple[str, ...],
    is_estimated: bool,
    frame: thor2.RGBDFrame,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    run = write_run(tmp_path / "run", trained)
    if not trained:  # the gallery answers
        assert_refused("neither classes nor enrolled objects", InferenceEngine, Settings(run, adapt=True))
        (library := thor2.Recognizer.load(run)).enroll("tall", [(frame, 200)])
    if not is_estimated:  # The tests of thor2_jax.adaptation estimate transforms.
        monkeypatch.setattr(estimate, "objective", create_autospec(estimate.objective))
        monkeypatch.setattr(estimate, "estimate_transform", create_autospec(estimate_transform, side_effect=estimated))
    engine = InferenceEngine(Settings(run, adapt=True))
    engine.compile_adaptation()
    if not trained:
        library.enroll("wide", [(frame, 7)])
        engine.refresh()
    first, second = views(EVERY - 1), views(3)
    unusable = dataclasses.replace(first[0], reason="too few points")
    for frame, observe in ((first, True), ([unusable], True), (second, False)):
        corrected = engine.correct(frame, observe=observe)
        assert all(a is b for a, b in zip(corrected, frame, strict=True))
    assert engine.adaptation is None and adaptation_answer(None) is None
    engine.correct(second, observe=True)
    (thread := engine._online._thread).join()
    adaptation = engine.adaptation
    assert adaptation.instances == EVERY + 2
    if not (trained or is_estimated):  # Estimates use objects that were enrolled after the start, too.
        assert estimate.estimate_transform.call_args.args[1](pack_instances(second, 4)).shape == (4, 2)
    (corrected,) = engine.correct(second[:1], observe=True)
    assert engine._online._thread is thread  # that starts no estimate
    np.testing.assert_array_equal(corrected.colors, adaptation.transform(second[0].colors))
    answer = adaptation_answer(adaptation).model_dump()
    assert answer == {"instances": EVERY + 2, **dataclasses.asdict(adaptation.transform)}
    by_default = InferenceEngine(Settings(run))
    by_default.compile_adaptation()
    by_default.correct(views(2 * EVERY), observe=True)
    assert by_default.adaptation is None
