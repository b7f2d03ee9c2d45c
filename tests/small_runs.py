"""Runs and embeddings with random weights, which compile quickly, and what they answer."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flax import nnx
from numpy.typing import NDArray
from small_clouds import NETWORK

import thor2_jax as thor2
from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.model.inference import infer
from thor2_jax.model.run_directory import TrainedRun, save_run
from thor2_jax.networks.embedding import Embedding
from thor2_jax.networks.networks import FEATURES, MLP, EmbeddingSizes, input_size
from training.objects.builtin_objects import builtin_objects
from training.objects.surfaces import surfaces_of
from training.views.normalized_views import ViewSource

SMALL_CONFIG = thor2.DescriptorConfig(homology="closed_form", n_slices=2, n_strips=5, image_size=8)
"""A descriptor that compiles quickly."""


def untrained_run(
    classes: Sequence[str],
    features: Sequence[str] = FEATURES,
    config: thor2.DescriptorConfig = SMALL_CONFIG,
    record: dict[str, object] | None = None,
    seed: int = 0,
) -> TrainedRun:
    """Return a run whose classifiers have random weights, other ones for each feature."""
    classifiers = {
        name: random_classifier(input_size(name, config, NETWORK.n_regions), len(classes), seed + k)
        for k, name in enumerate(features)
    }
    return TrainedRun(config, NETWORK, tuple(classes), classifiers, record or {})


def save_untrained_run(folder: Path, *arguments: Any, **options: Any) -> Path:
    """Write the run that `untrained_run` returns for these arguments, and return its directory."""
    save_run(untrained_run(*arguments, **options), folder)
    return folder


def save_trained_run(
    folder: Path, source: ViewSource, config: thor2.DescriptorConfig, temperatures: Mapping[str, float] = {}, **fit: int
) -> Path:
    """Write an untrained run of TOPS with the record of a training on these views; `fit` has epochs, folds and fold."""
    record = {"dataset": dict(source.record), "learning_rates": [1e-2, 1e-3], "batch_size": 8, "seed": 0, **fit}
    return save_untrained_run(folder, source.classes, ("tops",), config, record | {"temperatures": temperatures})


def random_classifier(n_inputs: int, n_classes: int, seed: int) -> MLP:
    """Return a classifier with random weights."""
    return MLP(n_inputs, n_classes, rngs=nnx.Rngs(seed))


def small_embedding(seed: int = 0) -> Embedding:
    """Return an embedding with random weights, which compiles quickly."""
    return Embedding.create(SMALL_CONFIG, sizes=EmbeddingSizes(4, (16,), 8, 4), seed=seed)


def untrained_embedding_run(
    classes: Sequence[str],
    features: Sequence[str] = (),
    config: thor2.DescriptorConfig = SMALL_CONFIG,
    record: dict[str, object] | None = None,
) -> TrainedRun:
    """Return a run whose embedding, two networks with random weights, recognizes the classes; by default, it alone."""
    run = untrained_run(classes, features, config, record)
    sizes = EmbeddingSizes(cell=4, hidden=(8,), learned=4, color=2)
    first = Embedding.create(config, run.network, sizes, classes=run.classes, distractors=2)
    return dataclasses.replace(run, embedding=dataclasses.replace(first, further=(first.create_further(1),)))


def with_surfaces(run: TrainedRun) -> TrainedRun:
    """Return a run with the surfaces of built-in objects as those of its classes."""
    meshes = list(builtin_objects().values())[: len(run.classes)]
    return dataclasses.replace(run, surfaces=surfaces_of(meshes))


def class_probabilities(
    recognizer: thor2.Recognizer, oriented: LookDescriptors, classifiers: Sequence[str] | None = None
) -> dict[str, NDArray[np.float32]]:
    """Return classifier -> class probabilities [B, C], of all classifiers or of those named."""
    names = tuple(recognizer.model.classifiers) if classifiers is None else classifiers
    computed = infer(recognizer.model, oriented, classifiers=names).probabilities
    return {name: np.asarray(values) for name, values in computed.items()}


def assert_same_answers(
    answers: Iterable[thor2.Recognition], expected: Iterable[thor2.Recognition], tolerance: float
) -> None:
    """Assert that answers are equal, up to a tolerance of the confidences."""
    exact = {field.name for field in dataclasses.fields(thor2.Recognition)} - {"confidence", "top"}
    for one, other in zip(answers, expected, strict=True):
        assert {name: getattr(one, name) for name in exact} == {name: getattr(other, name) for name in exact}
        assert one.confidence == pytest.approx(other.confidence, abs=tolerance) and one.top.keys() == other.top.keys()
