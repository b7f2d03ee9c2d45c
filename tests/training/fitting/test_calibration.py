"""Calibration: temperatures against SciPy, scikit-learn and known ones, and the confidence of a run."""

import dataclasses
import sys

import jax
import numpy as np
import pytest
from flax import nnx
from scipy.special import softmax
from small_clouds import NETWORK, random_clouds
from small_runs import SMALL_CONFIG, untrained_embedding_run

import thor2_jax as thor2
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.model.fusion import Calibration
from thor2_jax.model.inference import Inference
from thor2_jax.networks.networks import MLP, Feature, feature_of, input_size
from thor2_jax.types import Cloud
from training.fitting import fit as module
from training.fitting.fit import FitContext
from training.fitting.samples import MIRRORS, sample_views
from training.views.normalized_views import MemoryViews, padded_batches

pytestmark = pytest.mark.usefixtures("small_classifiers")

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=2, n_strips=8, image_size=8)


@pytest.mark.parametrize("feature", ["ce", pytest.param("tops2", marks=pytest.mark.slow)])
def test_sample_probabilities_equal_those_of_the_clouds(feature: Feature, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SAMPLES_PER_BATCH", 3)
    views = MemoryViews({"brick": random_clouds(0, [90] * 2), "stick": random_clouds(1, [90] * 2)}, CONFIG)
    samples, _ = sample_views(views, NETWORK, CONFIG)
    model = MLP(input_size(feature, CONFIG, NETWORK.n_regions), 3, rngs=nnx.Rngs(0))  # the third class has no samples
    rows = np.array([7, 0, 7, 3, 5])
    monkeypatch.setitem(sys.modules, "gudhi", None)  # a fit does not need it, whatever the descriptor of the run
    context = FitContext(feature, NETWORK, dataclasses.replace(CONFIG, homology="gudhi"))
    probabilities = module.sample_probabilities(model, samples, rows, context)
    probabilities_of = jax.jit(lambda described: jax.nn.softmax(model(feature_of(described, feature))))
    expected = []
    for index in range(2):
        ((_, normal),) = padded_batches(views.read(index).clouds())
        for axes in MIRRORS:
            aligned = thor2.turn(thor2.mirror(normal, axes), CONFIG)
            described = thor2.describe_aligned(aligned, NETWORK, CONFIG)
            expected.append(np.asarray(probabilities_of(described))[:2])
    np.testing.assert_allclose(probabilities, np.concatenate(expected)[rows], atol=1e-5)
    assert module.sample_probabilities(model, samples, rows[:0], context).shape == (0, 3)


@pytest.mark.parametrize("temperature", [0.4, 1.0, 3.0])
def test_known_temperature_is_recovered(temperature: float) -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 2, (20_000, 5))
    truth = (softmax(logits, axis=1).cumsum(axis=1) < rng.random((20_000, 1))).sum(axis=1)
    scaled = softmax(logits * temperature, axis=1)
    assert module.fit_temperature(scaled, truth) == pytest.approx(temperature, rel=0.05)


def test_probabilities_of_zero() -> None:
    probabilities = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], np.float32)
    assert 1 < module.fit_temperature(probabilities, np.array([0, 1, 1])) <= 100


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
        patch.setattr(module, "infer_clouds", lambda *_: inference)
        return module.fit_calibration(run, held_out)


def test_confidence_separates_and_keeps_its_share(held_out: Views) -> None:
    """Known objects (labels 0 and 1) with high odds, unknown ones with low odds; a tenth of the known are wrong."""
    known = LABEL < 2
    right = np.where(known, LABEL, 0)
    rng = np.random.default_rng(1)
    wrong = known & (np.arange(40) % 10 == 1)
    answer = np.where(wrong, 1 - right, right)
    fused = np.stack([np.where(answer == k, 0.8, 0.2) for k in (0, 1)], axis=1)
    embedded = fused * np.where(wrong, 0.5, np.where(known, rng.uniform(0.8, 0.99, 40), 0.1))[:, None]
    fitted, accuracy = fit(fused, embedded, held_out)
    assert fitted is not None and min(fitted.known_factor, fitted.score_factor) > 0
    scores, correct = fitted.confidence(fused, embedded), answer == LABEL
    assert np.min(scores[known & ~wrong]) > 0.7 > np.max(scores[~known])
    assert accuracy == correct[known].mean() < 1
    assert np.mean(scores[known]) == pytest.approx(correct[known].mean(), abs=2e-4)  # fitted on known objects
    assert np.mean(scores[correct] >= fitted.unknown_below) >= 0.95 > np.mean(scores[correct] > fitted.unknown_below)
    unknown = [(label + 2, cloud) for label, cloud in held_out]  # without correct answers, there is no confidence
    assert fit(fused, embedded, unknown)[0] is None


def test_unknown_objects_are_told_apart_without_incorrect_answers(held_out: Views) -> None:
    """Both kinds have equal weights: that there are twice as many unknown ones adds no bias."""
    label = LABEL[LABEL != 1]
    known = label < 2
    fused = np.stack([np.where(np.where(known, label, 0) == k, 0.9, 0.1) for k in (0, 1)], axis=1)
    embedded = fused * np.where(known, 0.9, 0.1)[:, None]
    fitted, accuracy = fit(fused, embedded, [view for view in held_out if view[0] != 1])
    assert fitted is not None and accuracy == 1 and abs(fitted.known_bias) < 1e-3
    scores = fitted.confidence(fused, embedded)
    assert np.max(scores[~known]) < fitted.unknown_below <= np.min(scores[known]) + 1e-9


def test_held_out_views_have_the_looks_of_the_run(held_out: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    """The threshold is that of the answers to all clouds in one batch, in their own order."""
    run = untrained_embedding_run(("a", "b"), config=dataclasses.replace(SMALL_CONFIG, looks=4))
    assert run.embedding is not None
    monkeypatch.setattr(module, "KEPT", 0.75)  # the lowest confidence is the same with one look
    sizes = np.random.default_rng(2).permutation(np.arange(100, 140))
    views = [(label, (xyz[:n], rgb[:n])) for n, (label, (xyz, rgb)) in zip(sizes, held_out, strict=True)]
    fitted, accuracy = module.fit_calibration(run, views)
    assert fitted is not None
    ((_, clouds),) = padded_batches([cloud for _, cloud in views])
    thresholds = []
    for looks in (4, 1):
        described = describe_looks(clouds, NETWORK, SMALL_CONFIG, looks)
        embedded = np.asarray(run.embedding.class_probabilities(described))[:40]
        fused = embedded.astype(np.float64) / embedded.sum(axis=1, keepdims=True, dtype=np.float64)
        correct = fused.argmax(axis=1) == LABEL
        thresholds.append(np.quantile(fitted.confidence(fused, embedded)[correct], 0.25, method="lower"))
        if looks == 4:
            assert accuracy == correct.sum() / (LABEL < 2).sum()
    assert fitted.unknown_below == pytest.approx(thresholds[0], abs=1e-6)
    assert abs(thresholds[0] - thresholds[1]) > 1e-5
