"""Fitting: separable classes are learned, results are reproducible, metrics are logged, invalid input is refused.

Calibration: temperatures against SciPy, scikit-learn and known ones, and the confidence of a run.
"""

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import numpy as np
import optax
import pytest
from flax import nnx
from refusals import assert_refused
from scipy.special import softmax
from small_clouds import NETWORK, random_clouds
from small_runs import SMALL_CONFIG, untrained_embedding_run

import thor2_jax as thor2
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.model.fusion import Calibration
from thor2_jax.model.inference import Inference
from thor2_jax.networks.networks import MLP, Feature, feature_of, input_size, model_arrays
from thor2_jax.types import Cloud
from training import train_run
from training.fitting import fit as module
from training.fitting.fit import FitContext, FitState, fit, train_step
from training.fitting.loop import Checkpoints, EpochMetrics, FitOptions
from training.fitting.samples import MIRRORS, Samples, describe_batch, sample_views
from training.views.normalized_views import MemoryViews, padded_batches

pytestmark = pytest.mark.usefixtures("small_classifiers")

CONFIG = thor2.DescriptorConfig(n_slices=2, n_strips=5, image_size=12)  # small, to compile quickly
TOPS2 = FitContext("tops2", NETWORK, CONFIG)
QUICK = FitOptions(epochs=8, batch_size=16, seed=3)

Fit = Callable[..., tuple[MLP, int]]

BOXES = {"long": ((0.2, 0.05, 0.05), 0), "short": ((0.06, 0.05, 0.05), 0), "white": ((0.06, 0.05, 0.05), 255)}
"""Class -> size and colour."""


@pytest.fixture(scope="module")
def separable() -> Samples:
    """Return 48 samples of three classes, which differ in shape or colour."""
    views = {name: random_clouds(k, [200] * 8, *box) for k, (name, box) in enumerate(BOXES.items())}
    return sample_views(MemoryViews(views, CONFIG), NETWORK, CONFIG)[0]


@pytest.fixture
def fitted(tmp_path: Path, separable: Samples) -> Fit:
    """Return `fit` on the separable samples, with a new checkpoint directory for each call."""
    folders = (tmp_path / str(number) for number in range(99))

    def run(options: FitOptions = QUICK, samples: Samples = separable, log: Any = lambda _: None, **more: Any) -> Any:
        return fit(samples, TOPS2, options, Checkpoints(next(folders), log), **more)

    return run


def descriptors(samples: Samples) -> np.ndarray:
    batch = samples.take(np.arange(len(samples)), NETWORK, CONFIG)
    return np.asarray(describe_batch(batch, NETWORK, TOPS2.config).tops2)


def answers(model: MLP, samples: Samples) -> np.ndarray:
    return np.asarray(jax.jit(model)(descriptors(samples)).argmax(axis=1))


def test_separable_classes_are_learned(separable: Samples, fitted: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the first of three steps, an epoch takes 2 s."""
    monkeypatch.setattr("training.fitting.loop.time.perf_counter", (2.0 * k for k in range(99)).__next__)
    curve: list[EpochMetrics] = []
    steps: list[tuple[int, int, int]] = []
    model, best = fitted(log=curve.append, progress=lambda done, total, row: steps.append((done, total, row.epoch)))
    assert (answers(model, separable) == separable.label).all()
    assert [metrics.epoch for metrics in curve] == list(range(1, 9))
    assert curve[-1].loss < curve[0].loss / 2 and curve[-1].accuracy > 0.8
    assert best == min(curve, key=lambda metrics: metrics.loss).epoch
    assert all(metrics.held_out_accuracy is None for metrics in curve)
    assert {metrics.samples_per_second for metrics in curve} == {2 * 16 / 2}
    assert steps == [(3 * epoch, 24, epoch) for epoch in range(1, 9)]


def test_the_held_out_set_is_evaluated_but_not_trained_on(separable: Samples, fitted: Fit) -> None:
    """The held-out set is mislabelled, so that its accuracy falls to 0; the best epoch has the highest accuracy."""
    held_out = np.arange(48) % 5 == 0
    label = (separable.label + held_out * (1 + np.arange(48) % 2).astype(np.int32)) % 3
    mislabelled = dataclasses.replace(separable, label=label)
    curve: list[EpochMetrics] = []
    model, best = fitted(samples=mislabelled, held_out=held_out, rows=np.arange(48)[::-1], log=curve.append)
    assert max(metrics.held_out_accuracy or 0 for metrics in curve) == curve[best - 1].held_out_accuracy
    assert curve[best - 1].held_out_accuracy == pytest.approx((answers(model, separable) == label)[held_out].mean())
    assert curve[-1].accuracy > 0.8 and curve[best - 1].held_out_accuracy > curve[-1].held_out_accuracy == 0


def test_a_finished_fit_returns_its_classifier_without_steps(separable: Samples, fitted: Fit, tmp_path: Path) -> None:
    """Another fit with the same seed gives the same weights, one with another seed does not."""
    refuse = lambda *_: pytest.fail("the fit made a step")  # noqa: E731
    options = dataclasses.replace(QUICK, epochs=2)
    first = fit(separable, TOPS2, options, Checkpoints(tmp_path / "c"))
    second = fit(separable, TOPS2, options, Checkpoints(tmp_path / "c", refuse), None, refuse)
    again, other = fitted(options=options), fitted(options=dataclasses.replace(options, seed=4))
    assert first[1] == second[1] == again[1]
    for model in (second[0], again[0]):
        np.testing.assert_equal(model_arrays(model), model_arrays(first[0]))
    assert np.abs(other[0].head.kernel[...] - first[0].head.kernel[...]).max() > 1e-3


def test_each_epoch_has_its_order_dropout_and_learning_rate(fitted: Fit) -> None:
    """The second of two epochs has the second rate."""
    options = FitOptions(epochs=1, batch_size=16, learning_rates=(1e-2, 1e-12))
    with mock.patch("training.fitting.fit.train_step", wraps=train_step) as step:
        first, both = (fitted(dataclasses.replace(options, epochs=epochs))[0] for epochs in (1, 2))
    np.testing.assert_allclose(both.head.kernel[...], first.head.kernel[...], atol=1e-6)
    assert [call.args[6] for call in step.call_args_list] == [*range(3), *range(6)]
    context, graph, _, batch, rate, seed, _ = step.call_args.args
    state = jax.tree.map(np.asarray, FitState.initial(first, optax.adam(rate))[1])
    losses = [train_step(context, graph, state, batch, rate, seed, number)[1][0].item() for number in (0, 0, 1)]
    assert losses[0] == losses[1] != losses[2]
    batches = [np.asarray(call.args[3].length).tobytes() for call in step.call_args_list]
    assert batches[:3] == batches[3:6] and len(set(batches)) == 6


def test_inputs_are_scaled_per_block_to_unit_root_mean_square(separable: Samples, fitted: Fit) -> None:
    model, _ = fitted(options=FitOptions(epochs=1))
    blocks = np.asarray(model.input_scale[...]) * descriptors(separable)
    for block in np.split(blocks.reshape(48, 2, 144 + 110), [144], axis=2):
        assert np.sqrt((block.astype(np.float64) ** 2).mean()) == pytest.approx(1, rel=1e-4)


def test_few_samples_make_one_batch_and_one_is_refused(fitted: Fit) -> None:
    steps: list[int] = []
    first_five = np.arange(48) > 4
    fitted(FitOptions(epochs=1), held_out=first_five, progress=lambda done, *others: steps.append(done))
    assert steps == [1]
    assert_refused("1 samples", fitted, held_out=np.arange(48) > 0)


def test_infinite_loss_is_refused_and_the_last_checkpoint_stays(separable: Samples, tmp_path: Path) -> None:
    broken = dataclasses.replace(separable, strips=separable.strips * np.nan)
    fit(separable, TOPS2, dataclasses.replace(QUICK, epochs=2), Checkpoints(tmp_path / "c"))
    assert_refused("loss of tops2 is nan .*3", fit, broken, TOPS2, QUICK, Checkpoints(tmp_path / "c"))
    assert Checkpoints(tmp_path / "c").last_epoch == 2
    fit(separable, TOPS2, QUICK, Checkpoints(tmp_path / "c"))


def test_invalid_options_are_refused_by_name() -> None:
    for name, value in (("epochs", 0), ("batch_size", 1), ("seed", -1), ("seed", 2**31)):
        assert_refused(f"^{name} is {value};", FitOptions, **{name: value})


def test_later_metrics_of_a_classifier_are_removed(tmp_path: Path) -> None:
    """Only in its fold; a last line that was cut off by a crash is ignored, and removed, too."""
    path, logged = tmp_path / "metrics.jsonl", [(0, "ce", 1), (0, "ce", 2), (0, "tops", 2), (1, "ce", 2)]
    train_run.remove_later_metrics(path, 0, "ce", 0)
    for fold, classifier, epoch in logged:
        train_run.log_metrics(path, fold, classifier, EpochMetrics(epoch, 1.0, 0.5, 1000.0))
    for rest in ("", '{"fold": 0, "cl'):
        path.write_text(path.read_text() + rest)
        assert [(r["fold"], r["classifier"], r["epoch"]) for r in train_run.read_metrics(path)] == logged
    train_run.remove_later_metrics(path, 0, "ce", 1)
    train_run.log_metrics(path, 0, "ce", EpochMetrics(2, 1.0, 0.5, 1000.0))
    rows = train_run.read_metrics(path)
    assert [(r["fold"], r["classifier"], r["epoch"]) for r in rows] == [logged[0], *logged[2:], logged[1]]


CLOSED_FORM = thor2.DescriptorConfig(homology="closed_form", n_slices=2, n_strips=8, image_size=8)


@pytest.mark.parametrize("feature", ["ce", pytest.param("tops2", marks=pytest.mark.slow)])
def test_sample_probabilities_equal_those_of_the_clouds(feature: Feature, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SAMPLES_PER_BATCH", 3)
    views = MemoryViews({"brick": random_clouds(0, [90] * 2), "stick": random_clouds(1, [90] * 2)}, CLOSED_FORM)
    samples, _ = sample_views(views, NETWORK, CLOSED_FORM)
    # The third class has no samples.
    model = MLP(input_size(feature, CLOSED_FORM, NETWORK.n_regions), 3, rngs=nnx.Rngs(0))
    rows = np.array([7, 0, 7, 3, 5])
    monkeypatch.setitem(sys.modules, "gudhi", None)  # a fit does not need it, whatever the descriptor of the run
    context = FitContext(feature, NETWORK, dataclasses.replace(CLOSED_FORM, homology="gudhi"))
    probabilities = module.sample_probabilities(model, samples, rows, context)
    probabilities_of = jax.jit(lambda described: jax.nn.softmax(model(feature_of(described, feature))))
    expected = []
    for index in range(2):
        ((_, normal),) = padded_batches(views.read(index).clouds())
        for axes in MIRRORS:
            aligned = thor2.turn(thor2.mirror(normal, axes), CLOSED_FORM)
            described = thor2.describe_aligned(aligned, NETWORK, CLOSED_FORM)
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


def calibrated(fused: np.ndarray, embedded: np.ndarray, held_out: Views) -> tuple[Calibration | None, float]:
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
    fitted, accuracy = calibrated(fused, embedded, held_out)
    assert fitted is not None and min(fitted.known_factor, fitted.score_factor) > 0
    scores, correct = fitted.confidence(fused, embedded), answer == LABEL
    assert np.min(scores[known & ~wrong]) > 0.7 > np.max(scores[~known])
    assert accuracy == correct[known].mean() < 1
    assert np.mean(scores[known]) == pytest.approx(correct[known].mean(), abs=2e-4)  # fitted on known objects
    assert np.mean(scores[correct] >= fitted.unknown_below) >= 0.95 > np.mean(scores[correct] > fitted.unknown_below)
    unknown = [(label + 2, cloud) for label, cloud in held_out]  # without correct answers, there is no confidence
    assert calibrated(fused, embedded, unknown)[0] is None


def test_unknown_objects_are_told_apart_without_incorrect_answers(held_out: Views) -> None:
    """Both kinds have equal weights: that there are twice as many unknown ones adds no bias."""
    label = LABEL[LABEL != 1]
    known = label < 2
    fused = np.stack([np.where(np.where(known, label, 0) == k, 0.9, 0.1) for k in (0, 1)], axis=1)
    embedded = fused * np.where(known, 0.9, 0.1)[:, None]
    fitted, accuracy = calibrated(fused, embedded, [view for view in held_out if view[0] != 1])
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
