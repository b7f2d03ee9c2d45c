"""Fit of the confidence on a held-out set with known and unknown objects."""

import dataclasses

import numpy as np
import pytest
from helpers import SMALL_CONFIG, random_clouds, untrained_embedding_run

import colornet
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.model.confidence import Calibration
from thor2_jax.model.inference import Inference
from thor2_jax.types import Cloud
from training.fitting import calibration
from training.fitting.calibration import fit_calibration
from training.views.normalized_views import CLOUDS_PER_BATCH, padded_batches

NETWORK = colornet.load_default()

Views = list[tuple[int, Cloud]]

LABEL = np.arange(40) % 4


@pytest.fixture(scope="module")
def held_out() -> Views:
    return list(zip(LABEL.tolist(), random_clouds(0, [200] * 40), strict=True))


def fit(fused: np.ndarray, embedded: np.ndarray, held_out: Views) -> tuple[Calibration | None, float]:
    """Fit the confidence of a run whose classifiers and embedding answer with these probabilities."""
    run = untrained_embedding_run(("a", "b"), ("tops", "tops2"))
    values = {"tops": fused, "tops2": fused, "embedding": embedded}
    inference = Inference(0, {k: np.resize(v, (128, 2)) for k, v in values.items()})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "infer_clouds", lambda *_: inference)
        return fit_calibration(run, run.embedding, held_out)


def test_confidence_separates_and_keeps_its_share(held_out: Views) -> None:
    """Known objects (labels 0 and 1) with high odds, unknown ones with low odds; a tenth of the known are wrong."""
    known = LABEL < 2
    right = np.where(known, LABEL, 0)
    rng = np.random.default_rng(1)
    top = np.where(known, rng.uniform(0.8, 0.99, 40), rng.uniform(0.5, 0.9, 40))
    wrong = known & (np.arange(40) % 10 == 1)
    top, answer = np.where(wrong, 0.55, top), np.where(wrong, 1 - right, right)
    fused = np.stack([np.where(answer == k, top, 1 - top) for k in (0, 1)], axis=1)
    embedded = fused * np.where(known, 0.9, 0.1)[:, None]
    fitted, accuracy = fit(fused, embedded, held_out)
    assert fitted is not None and min(fitted.known_factor, fitted.correct_factor, fitted.score_factor) > 0
    scores, correct = fitted.confidence(fused, embedded), answer == LABEL
    assert np.min(scores[known & ~wrong]) > 0.7 > np.max(scores[~known])
    assert accuracy == correct[known].mean() < 1
    assert np.mean(scores[known]) == pytest.approx(correct[known].mean(), abs=0.05)  # most instances are known
    assert fitted.unknown_below == pytest.approx(np.quantile(scores[correct], 1 - calibration.KEPT))
    unknown = [(label + 2, cloud) for label, cloud in held_out]  # without correct answers, there is no confidence
    assert fit(fused, embedded, unknown)[0] is None


def test_unknown_objects_are_told_apart_without_incorrect_answers(held_out: Views) -> None:
    known = LABEL < 2
    fused = np.stack([np.where(np.where(known, LABEL, 0) == k, 0.9, 0.1) for k in (0, 1)], axis=1)
    embedded = fused * np.where(known, 0.9, 0.1)[:, None]
    fitted, accuracy = fit(fused, embedded, held_out)
    assert fitted is not None and accuracy == 1
    scores = fitted.confidence(fused, embedded)
    assert np.max(scores[~known]) < fitted.unknown_below <= np.min(scores[known]) + 1e-9


def test_held_out_views_are_recognized_in_the_looks_of_the_run(held_out: Views) -> None:
    """The threshold is that of the answers to all clouds in one batch, in their own order."""
    run = untrained_embedding_run(("a", "b"), config=dataclasses.replace(SMALL_CONFIG, looks=4))
    assert run.embedding is not None
    sizes = np.random.default_rng(2).permutation(np.arange(100, 140))
    views = [(label, (xyz[:n], rgb[:n])) for n, (label, (xyz, rgb)) in zip(sizes, held_out, strict=True)]
    fitted, accuracy = fit_calibration(run, run.embedding, views)
    assert fitted is not None
    ((_, clouds),) = padded_batches([cloud for _, cloud in views], CLOUDS_PER_BATCH)
    thresholds = []
    for looks in (4, 1):
        described = describe_looks(clouds, NETWORK, SMALL_CONFIG, looks)
        embedded = np.asarray(run.embedding.class_probabilities(described))[:40]
        fused = embedded.astype(np.float64) / embedded.sum(axis=1, keepdims=True, dtype=np.float64)
        correct = fused.argmax(axis=1) == LABEL
        thresholds.append(np.quantile(fitted.confidence(fused, embedded)[correct], 1 - calibration.KEPT))
        if looks == 4:
            assert accuracy == correct.sum() / (LABEL < 2).sum()
    assert fitted.unknown_below == pytest.approx(thresholds[0], abs=1e-6)
    assert abs(thresholds[0] - thresholds[1]) > 1e-5
