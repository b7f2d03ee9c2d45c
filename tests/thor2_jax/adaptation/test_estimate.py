"""The colour transform of a camera, its estimate, and recognizers that use it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from image_files import frame_of_squares
from refusals import assert_refused
from scipy.stats import entropy as scipy_entropy
from slow_tier import slow
from small_clouds import random_clouds
from small_runs import class_probabilities, untrained_embedding_run, untrained_run

import thor2_jax as thor2
from thor2_jax.adaptation import estimate
from thor2_jax.adaptation.estimate import GRID, adaptation_criterion, estimate_transform, posterior_mean
from thor2_jax.descriptor.looks import describe_looks
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.model.fusion import FusionRule
from thor2_jax.model.model import ColorTransform
from thor2_jax.recognizer import Recognizer

run = functools.cache(lambda: untrained_run(("a", "b", "c"), ("tops", "tops2"), seed=1))
WARM = ColorTransform(gamma=0.2, gain=-0.1, saturation=0.3, warmth=0.1)


def instances(count: int) -> list[PreparedInstance]:
    clouds = random_clouds(0, [200] * count)
    return [PreparedInstance(label, *cloud, np.zeros(200, bool)) for label, cloud in enumerate(clouds, start=1)]


CLOUDS = pack_instances(instances(4), 8)


def test_a_transform_follows_its_formula() -> None:
    colors = np.array([[0, 0, 0], [255, 255, 255], [200, 100, 50], [10, 20, 250]], np.uint8)
    np.testing.assert_array_equal(ColorTransform()(colors), colors)
    values = (colors / 255) ** np.exp(0.2) * np.exp(-0.1) * np.exp([0.1, 0, -0.1])
    grey = values @ [0.299, 0.587, 0.114]
    expected = (grey[:, None] + np.exp(0.3) * (values - grey[:, None])).clip(0, 1)
    np.testing.assert_allclose(WARM(colors), 255 * expected, atol=0.51)
    parameters = jnp.array(dataclasses.astuple(WARM))
    np.testing.assert_allclose(estimate.transform_colors(parameters, jnp.asarray(colors / 255)), expected, atol=1e-5)


@pytest.mark.parametrize("stored", [{"gamma": float("nan")}, {"gain": 9.0}, {"gamma": "x"}, {"hue": 1.0}, [1]])
def test_a_damaged_transform_is_refused(stored: object) -> None:
    assert_refused("color_transform", Recognizer, dataclasses.replace(run(), record={"color_transform": stored}))


def test_entropy_counts_what_the_classes_lack() -> None:
    p = np.array([[0.2, 0.3, 0.1], [0, 0, 0], [1, 0, 0], [0.5, 0.5, 0]])
    expected = [scipy_entropy([*row, 1 - sum(row)]) for row in p]
    np.testing.assert_allclose(estimate.entropy(jnp.asarray(p)), expected, atol=1e-5)


@pytest.mark.parametrize("rule", ["max", "log-mean", *slow("mean")])
def test_the_objective_is_the_entropy_of_the_answers(rule: FusionRule) -> None:
    made = instances(11)  # two chunks, one with padding
    recognizer = Recognizer(run(), rule=rule)
    criterion = adaptation_criterion(recognizer.model)
    total = estimate.objective(made, lambda clouds: criterion(clouds) / 2)  # the other half: unknown, before and after
    for transform in (ColorTransform(), WARM):
        corrected = [dataclasses.replace(each, colors=transform(each.colors)) for each in made]
        expected = 0.0
        for part in (corrected[:8], corrected[8:]):
            oriented = describe_looks(pack_instances(part, 8), run().network, run().config, 2)
            fused = recognizer.model.fused(class_probabilities(recognizer, oriented, ("tops", "tops2")))[: len(part)]
            expected += sum(scipy_entropy([*row / 2, 0.5]) - 0.5 * np.log(0.5) for row in fused)
        # Colours are rounded to 8 bits before a camera's correction, not in between.
        assert total(np.array(dataclasses.astuple(transform))) == pytest.approx(expected, rel=2e-3)


def grey_is_known(clouds: thor2.PointClouds) -> jax.Array:
    """Answer one class, the more surely the closer the mean colour is to grey."""
    mean = jnp.mean(clouds.colors, axis=1, where=clouds.mask[..., None])
    return jnp.exp(-10 * jnp.square(mean[:, :1] - mean[:, 2:]))


def none_is_known(clouds: thor2.PointClouds) -> jax.Array:
    return jnp.zeros((len(clouds.mask), 3))


@pytest.mark.slow
def test_warm_colors_are_cooled_and_unknown_objects_change_nothing() -> None:
    made = [dataclasses.replace(each, colors=np.full_like(each.colors, (150, 110, 90))) for each in instances(40)]
    adaptation = estimate_transform(made, grey_is_known)
    assert -0.36 < adaptation.transform.warmth < -0.1
    assert adaptation.transform == ColorTransform(warmth=adaptation.transform.warmth)
    assert adaptation.uncertainty_after < adaptation.uncertainty_before and adaptation.instances == 40
    unchanged = estimate_transform(made, none_is_known).transform
    np.testing.assert_allclose(dataclasses.astuple(unchanged), 0, atol=1e-6)


def test_the_posterior_mean_weighs_evidence_and_prior() -> None:
    np.testing.assert_allclose(posterior_mean(np.full(len(GRID), 7.0)), 0, atol=1e-12)
    certain = np.where(np.arange(len(GRID)) == 17, 0, 1e6)
    np.testing.assert_allclose(posterior_mean(certain), GRID[17])
    totals = np.random.default_rng(0).uniform(0, 3, len(GRID))
    weights = np.exp(-0.5 * totals) * np.exp(-0.5 * (GRID[:, 3] / 0.085) ** 2)
    np.testing.assert_allclose(posterior_mean(totals), (weights[:, None] * GRID).sum(axis=0) / weights.sum())


def test_instances_are_spread_evenly_and_too_few_are_refused() -> None:
    few = [*instances(9), dataclasses.replace(instances(1)[0], reason="too few points")]
    assert estimate.evenly_spread(7, 3).tolist() == [0, 3, 6]
    assert estimate.evenly_spread(7, 40).tolist() == list(range(7))
    message = "9 usable instances; expected at least 10: .* unusable ones .1.; .* too few points"
    assert_refused(message, estimate_transform, few, none_is_known)


def frame(seed: int, shape: tuple[int, int] = (120, 160)) -> thor2.RGBDFrame:
    """Return a frame of five squares of one colour each."""
    colors = np.random.default_rng(seed).integers(0, 256, (5, 3))
    squares = {k: (10 + 15 * (k % 3), 30 * k - 28, colors[k - 1]) for k in range(1, 6)}
    return frame_of_squares(squares, 25, shape)


def test_an_adapted_recognizer_sees_corrected_colors() -> None:
    """The frames may differ in size; too few instances change nothing."""
    recognizer = Recognizer(run())
    assert_refused("5 usable instances", recognizer.adapt, [frame(0)])
    assert recognizer.model.color_transform is None
    adaptation = recognizer.adapt([frame(0), frame(1, (110, 160))])
    assert recognizer.model.color_transform == adaptation.transform != ColorTransform() and adaptation.instances == 10
    image = frame(7)
    by_hand = dataclasses.replace(image, color=adaptation.transform(image.color))
    assert recognizer.recognize(image) == Recognizer(run()).recognize(by_hand)
    recognizer.enroll("mug", [(image, 2)])
    stored = next(iter(recognizer.gallery.objects["mug"].clouds.views()))
    np.testing.assert_array_equal(np.unique(stored.colors, axis=0), [by_hand.color[40, 40]])


def test_gallery_answers_are_its_scores() -> None:
    recognizer = Recognizer(untrained_run((), ()))
    assert_refused("neither classes nor enrolled objects", adaptation_criterion, recognizer.model)
    for name, seed in (("mug", 0), ("bowl", 1)):
        recognizer.enroll(name, [(frame(seed), 2), (frame(seed), 3)])
    embedding = recognizer.objects.embedding
    oriented = describe_looks(CLOUDS, embedding.network, embedding.config, 2).with_balanced(CLOUDS)
    scores = dataclasses.replace(recognizer.gallery, references=None).scores(embedding.embed_oriented(oriented))
    expected = scores / np.maximum(scores.sum(axis=1, keepdims=True), 1)
    np.testing.assert_allclose(adaptation_criterion(recognizer.model)(CLOUDS), expected, atol=2e-3)


def test_an_embedding_alone_is_the_criterion() -> None:
    recognizer = Recognizer(untrained_embedding_run(("a", "b", "c"), config=dataclasses.replace(run().config, looks=4)))
    oriented = describe_looks(CLOUDS, recognizer.run.network, recognizer.run.config, 2)
    expected = class_probabilities(recognizer, oriented)["embedding"]
    np.testing.assert_allclose(adaptation_criterion(recognizer.model)(CLOUDS), expected, rtol=1e-6)
