"""Fixtures shared by the tests of the command line."""

from pathlib import Path
from typing import Any

import pytest
from helpers import random_classifier, untrained_run

from thor2_jax.config import DescriptorConfig
from thor2_jax.model.classifier import MLP
from thor2_jax.model.run_directory import input_size, save_run
from training.fitting import job
from training.fitting.options import EpochMetrics
from training.fitting.samples import Samples
from training.fitting.steps import FitContext


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run directory with random weights."""
    directory = tmp_path_factory.mktemp("run")
    config = DescriptorConfig(homology="closed_form")  # a small grid would overflow, so that nothing has a name
    save_run(untrained_run(("bowl", "mug", "plate"), ("tops", "tops2"), config, seed=1), directory)
    return directory


@pytest.fixture
def unfitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trainings end without a step: their classifiers have random weights, and nothing is compiled for them."""

    def fit(
        samples: Samples,
        context: FitContext,
        options: Any,
        checkpoints: Any,
        held_out: Any,
        progress: Any,
        epoch_done: Any,
    ) -> tuple[MLP, int]:
        epoch_done(EpochMetrics(1, loss=1.0, accuracy=0.5, samples_per_second=1.0))
        inputs = input_size(context.feature, context.config, context.network.n_regions)
        return random_classifier(inputs, len(samples.classes), 0), 1

    monkeypatch.setattr(job, "fit", fit)
