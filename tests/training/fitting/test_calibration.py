"""Temperatures of the classifiers of a fold, and the samples that they are fitted to."""

import jax
import numpy as np
import pytest
from flax import nnx
from helpers import random_clouds

import colornet
import thor2_jax as thor2
from thor2_jax.model.classifier import MLP, Feature, class_probabilities
from thor2_jax.model.run_directory import input_size
from training.fitting import calibration
from training.fitting.calibration import fit_temperature, sample_probabilities, temperatures
from training.fitting.samples import MIRRORS, build_samples
from training.fitting.steps import FitContext
from training.views.normalized_views import MemoryViews, padded_batches

pytestmark = pytest.mark.usefixtures("small_classifiers")

CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=2, n_strips=8, image_size=8)
NETWORK = colornet.load_default()


def source(views: int) -> MemoryViews:
    return MemoryViews({name: random_clouds(k, [90] * views) for k, name in enumerate(("brick", "stick"))}, CONFIG)


@pytest.mark.parametrize("feature", ["ce", pytest.param("tops2", marks=pytest.mark.slow)])
def test_sample_probabilities_equal_those_of_the_clouds(feature: Feature, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "SAMPLES_PER_BATCH", 3)
    views = source(2)
    samples = build_samples(views, NETWORK, CONFIG)
    model = MLP(input_size(feature, CONFIG, NETWORK.n_regions), 2, rngs=nnx.Rngs(0))
    rows = np.array([7, 0, 3, 5])
    context = FitContext(feature, NETWORK, CONFIG)
    probabilities = sample_probabilities(model, samples, rows, context)
    probabilities_of = jax.jit(lambda described: class_probabilities(model, described, feature))
    expected = []
    for index in range(2):
        ((_, normal),) = padded_batches(views.read(index).clouds(), 2)
        for axes in MIRRORS:
            aligned = thor2.turn(thor2.mirror(normal, axes), CONFIG)
            described = thor2.describe_aligned(aligned, NETWORK, CONFIG)
            expected.append(np.asarray(probabilities_of(described)))
    np.testing.assert_allclose(probabilities, np.concatenate(expected)[rows], atol=1e-5)
    assert sample_probabilities(model, samples, rows[:0], context).shape == (0, 2)


def test_temperatures_are_fitted_to_the_held_out_set() -> None:
    samples = build_samples(source(3), NETWORK, CONFIG)
    model = MLP(input_size("tops", CONFIG, NETWORK.n_regions), 2, rngs=nnx.Rngs(0))
    held_out = samples.view == 1
    fitted = temperatures({"tops": model}, samples, held_out, NETWORK, CONFIG)
    probabilities = sample_probabilities(model, samples, np.flatnonzero(held_out), FitContext("tops", NETWORK, CONFIG))
    assert fitted == {"tops": fit_temperature(probabilities, samples.label[held_out])}
    assert temperatures({"tops": model}, samples, None, NETWORK, CONFIG) == {}
