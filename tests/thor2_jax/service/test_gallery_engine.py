"""The engine of the service on runs with enrolled objects, or with an embedding alone."""

import dataclasses
from pathlib import Path

import jax
import pytest
from helpers import SMALL_CONFIG, assert_same_answers, small_embedding, untrained_embedding_run, untrained_run

import thor2_jax as thor2
from thor2_jax.frames.prepared_instance import PreparedInstance, prepare_instance
from thor2_jax.model.confidence import Calibration
from thor2_jax.model.run_directory import EMBEDDING_FILE, save_run
from thor2_jax.service.engine import CloudResult, InferenceEngine
from thor2_jax.service.settings import Settings

pytestmark = pytest.mark.usefixtures("small_buckets")
SLOW = pytest.mark.slow


def inferred(engine: InferenceEngine, frame: thor2.RGBDFrame) -> tuple[list[PreparedInstance], list[CloudResult]]:
    """Return the instances of a frame, and the results of those that can be used."""
    instances = [prepare_instance(frame, label, engine.run.config.sigma_s) for label in frame.instances]
    return instances, engine.infer([instance for instance in instances if instance.reason is None])


@pytest.mark.parametrize(
    ("trained", "answer_by"),
    [(("a", "b"), None), pytest.param((), None, marks=SLOW), pytest.param(("a", "b"), "classifiers", marks=SLOW)],
)
def test_the_engine_answers_as_the_recognizer(
    trained: tuple[str, ...], answer_by: str | None, frame: thor2.RGBDFrame, tmp_path: Path
) -> None:
    record: dict[str, object] = {} if answer_by is None else {"answer_by": answer_by}
    save_run(untrained_run(trained, ("tops", "tops2") if trained else (), record=record), tmp_path / "run")
    small_embedding().save(tmp_path / "run" / EMBEDDING_FILE)
    recognizer = thor2.Recognizer.load(tmp_path / "run")
    recognizer.enroll("tall", [(frame, 200)])
    recognizer.enroll("wide", [(frame, 7)])
    engine = InferenceEngine(Settings(tmp_path / "run", max_batch=8))
    assert engine.model.names == (*trained, "tall", "wide")
    instances, results = inferred(engine, frame)
    assert_same_answers(engine.recognize(instances, results), recognizer.recognize(frame), 1e-4)
    assert engine.calibrated_confidences(results) == [None] * 3
    unusable = [instance for instance in instances if instance.reason is not None]
    assert [answer.name for answer in engine.recognize(unusable, [])] == [None]


@pytest.mark.parametrize("calibration", [None, Calibration(0.0, 1.0, 1.0, 0.5, 0.1)])
def test_an_embedding_alone_answers(calibration: Calibration | None, frame: thor2.RGBDFrame, tmp_path: Path) -> None:
    record: dict[str, object] = {} if calibration is None else {"calibration": dataclasses.asdict(calibration)}
    run = untrained_embedding_run(("a", "b", "c"), config=dataclasses.replace(SMALL_CONFIG, looks=2), record=record)
    save_run(run, tmp_path / "run")
    engine = InferenceEngine(Settings(tmp_path / "run", max_batch=8))
    assert engine.model.names == ("a", "b", "c") and tuple(engine.model.classifiers) == ("embedding",)
    instances, results = inferred(engine, frame)
    recognizer = thor2.Recognizer.load(tmp_path / "run")
    answers, expected = engine.recognize(instances, results), recognizer.recognize(frame)
    assert_same_answers(answers, expected, 1e-4)
    calibrated = engine.calibrated_confidences(results)
    of_usable = [one.confidence for one in expected if one.confidence is not None]
    assert len(of_usable) == len(results) and {one.classifier for one in answers} <= {"embedding", None}
    assert calibrated == (
        [None] * len(results) if calibration is None else [pytest.approx(each, abs=1e-4) for each in of_usable]
    )
    assert results[0].aligned.shape == (len(results[0].aligned), 3)
    assert jax.tree.map(len, results[0].inference.probabilities) == {"embedding": 3}
