"""The engine of the service on a run that has enrolled objects and no classifiers."""

from pathlib import Path

import pytest
from helpers import SMALL_CONFIG, untrained_run

import thor2_jax as thor2
from thor2_jax.gallery.embedding import Embedding, EmbeddingSizes
from thor2_jax.recognition.prepared_instance import prepare_instance
from thor2_jax.recognition.run_directory import EMBEDDING_FILE, save_run
from thor2_jax.service.engine import InferenceEngine
from thor2_jax.service.settings import Settings


@pytest.mark.parametrize(
    ("trained", "answer_by"), [((), None), (("a", "b"), None), (("a", "b"), "gallery"), (("a", "b"), "classifiers")]
)
def test_the_engine_answers_as_the_recognizer(
    trained: tuple[str, ...], answer_by: str | None, frame: thor2.RGBDFrame, tmp_path: Path
) -> None:
    record: dict[str, object] = {} if answer_by is None else {"answer_by": answer_by}
    save_run(untrained_run(trained, ("tops", "tops2") if trained else (), record=record), tmp_path / "run")
    Embedding.create(SMALL_CONFIG, sizes=EmbeddingSizes(4, (16,), 8, 4)).save(tmp_path / "run" / EMBEDDING_FILE)
    recognizer = thor2.Recognizer.load(tmp_path / "run")
    recognizer.enroll("tall", [(frame, 200)])
    recognizer.enroll("wide", [(frame, 7)])
    engine = InferenceEngine(Settings(tmp_path / "run", max_batch=8))
    assert engine.classes == (*trained, "tall", "wide")
    instances = [prepare_instance(frame, label, engine.run.config.sigma_s) for label in frame.instances]
    results = engine.infer([instance for instance in instances if instance.reason is None])
    answers = engine.recognize(instances, results)
    for answer, expected in zip(answers, recognizer.recognize(frame), strict=True):
        assert (answer.label, answer.name, answer.reason) == (expected.label, expected.name, expected.reason)
        assert answer.confidence == pytest.approx(expected.confidence, abs=1e-4)
        assert answer.classifier == expected.classifier and answer.top.keys() == expected.top.keys()
    assert engine.calibrated_confidences(results) == [None] * 3
    unusable = [instance for instance in instances if instance.reason is not None]
    assert [answer.name for answer in engine.recognize(unusable, [])] == [None]
