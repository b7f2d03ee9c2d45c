"""Fixtures shared by the tests of training."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from small_runs import random_classifier

from thor2_jax.figures import _PNG
from thor2_jax.networks.embedding import BACKGROUND, Embedding, References
from thor2_jax.networks.networks import MLP, EmbeddingSizes, input_size
from training import train_run
from training.fitting.fit import FitContext
from training.fitting.loop import EpochMetrics
from training.fitting.samples import Samples
from training.protocol import Stage

SAVEFIG = Figure.savefig


@pytest.fixture(scope="module", autouse=True)
def blank_pictures(module_patch: pytest.MonkeyPatch) -> None:
    """Let the pictures of figures be blank: many commands draw some, which takes a fifth of the time of a training."""
    module_patch.setattr(Figure, "savefig", lambda _, file, **options: Image.new("RGB", (400, 300)).save(file, "PNG"))


@pytest.fixture
def drawn_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let figures be drawn, with a fifth of their pixels."""
    monkeypatch.setattr(Figure, "savefig", SAVEFIG)
    monkeypatch.setitem(_PNG, "dpi", 60)


@pytest.fixture(scope="session")
def without_steps() -> Callable[[], contextlib.AbstractContextManager[None]]:
    """Return a context in which trainings end without a step: they have random weights, and nothing is compiled."""
    metrics = functools.partial(EpochMetrics, 1, 1.0, 0.5, 1.0)

    def fit(samples: Samples, context: FitContext, *others: Any) -> tuple[MLP, int]:
        _, checkpoints, held_out, _ = others
        checkpoints.log(metrics(held_out_accuracy=None if held_out is None else 0.5))
        inputs = input_size(context.feature, context.config, context.network.n_regions)
        return random_classifier(inputs, int(samples.label.max()) + 1, 0), 1

    def fit_embedding(fold: Any, distractors: Any) -> tuple[Embedding, list[Any]]:
        for stage in (Stage.RENDER_DISTRACTORS, Stage.DESCRIBE_EMBEDDED, Stage.FIT_NETWORKS):
            fold.progress(stage, 1, 1, "")
        fold.checkpoints("embedding").log(metrics())
        given, classes = fold.settings, fold.source.classes
        created = Embedding.create(given.config, given.network, train_run.RUN_SIZES, classes=classes, distractors=9)
        views = References(np.zeros((1, created.size), np.float16), np.full(1, BACKGROUND, np.int32))
        return dataclasses.replace(created, references=views), []

    @contextlib.contextmanager
    def patched() -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(train_run, "fit", fit)
            patch.setattr(train_run._Fold, "fit_embedding", fit_embedding)
            patch.setattr(train_run, "fit_calibration", lambda *_: (None, 0.5))
            yield

    return patched


@pytest.fixture
def unfitted(without_steps: Callable[[], contextlib.AbstractContextManager[None]]) -> Iterator[None]:
    with without_steps():
        yield


@pytest.fixture(params=["random", pytest.param("fitted", marks=pytest.mark.slow)])
def weights(request: pytest.FixtureRequest) -> str:
    """Let the trainings of a test end without a step; those of the slow test have all steps."""
    if request.param == "random":
        request.getfixturevalue("unfitted")
    return str(request.param)


@pytest.fixture(scope="module")
def small_networks(module_patch: pytest.MonkeyPatch) -> None:
    """Let the embeddings of runs have small networks, which are fitted in small batches."""
    module_patch.setattr(train_run, "RUN_SIZES", EmbeddingSizes(cell=4, hidden=(16,), learned=8, color=4))
    module_patch.setattr("training.embedding.fit.BATCH_SIZE", 64)
