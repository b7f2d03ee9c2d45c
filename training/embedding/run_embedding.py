"""The embedding of a run, fitted on views of its classes and of distractors: objects that are none of them.

Distractors are procedural objects, or meshes of other objects. They teach the embedding what is unknown; a tenth of
them is held out, so that the confidence is calibrated on unknown objects that no network was fitted on.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding
from training.embedding.fit import EmbeddingFit, fit_embedding
from training.embedding.samples import Samples, joined_samples, sample_views
from training.embedding.sampling import ObjectSource, build_samples
from training.storage.progress import Progress
from training.storage.workers import local_workers
from training.views.normalized_views import ViewSource

__all__ = ["Distractors", "fit_run_embedding"]

COPIES = 2
"""Samples of each view, in random orientations."""

N_NETWORKS = 3
"""Number of networks in the embedding of a run; docs/decisions.md says why."""

HELD_OUT = 10
"""One distractor of so many is held out."""


@dataclasses.dataclass(frozen=True)
class Distractors:
    """Objects that are none of the classes, and how the embedding is fitted on them and the classes.

    Attributes:
        procedural: number of procedural objects.
        meshes: name -> file of other objects.
        views: views of each distractor.
        epochs: passes over the samples.
        workers: rendering processes; they do not affect the result.

    Raises:
        InputError: there are fewer than ten distractors, or a number is out of range.
    """

    procedural: int = 1500
    meshes: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    views: int = 8
    epochs: int = 10
    workers: int = 1

    def __post_init__(self) -> None:
        count = self.procedural + len(self.meshes)
        if self.procedural < 0 or count < HELD_OUT or min(self.views, self.epochs, self.workers) < 1:
            raise InputError(
                f"distractors: there are {count} objects with {self.views} views, fitted in {self.epochs} epochs; "
                f"expected at least {HELD_OUT} objects, 1 view and 1 epoch"
            )

    @property
    def sources(self) -> list[ObjectSource]:
        """The meshes, then the procedural objects; the same kinds of objects at any place of the list."""
        mixed: list[ObjectSource] = [*self.meshes.values(), *range(self.procedural)]
        return [mixed[k] for k in np.random.default_rng(0).permutation(len(mixed))]

    def check(self, classes: Sequence[str]) -> None:
        """Raise InputError if a distractor has the name of a class."""
        shared = sorted(set(self.meshes) & set(classes))
        if shared:
            raise InputError(
                f"distractors: {shared[0]!r} is also a class; expected other objects; remove its mesh from one of the "
                "two directories"
            )

    @property
    def record(self) -> dict[str, Any]:
        """What determines the embedding, as JSON holds it."""
        return {
            "procedural": self.procedural,
            "meshes": sorted(self.meshes),
            "views": self.views,
            "epochs": self.epochs,
            "networks": N_NETWORKS,
        }


def fit_run_embedding(
    source: ViewSource,
    held_out: Mapping[int, NDArray[np.integer[Any]]],
    distractors: Distractors,
    directory: Path,
    network: ColorNetwork,
    config: DescriptorConfig,
    seed: int,
    progress: Progress,
) -> tuple[Embedding, Samples]:
    """Fit the embedding of a run.

    Args:
        source: normalized views of the classes.
        held_out: label -> indices of the views of the held-out set.
        distractors: the other objects.
        directory: for the samples of the distractors, from which an interrupted training resumes.
        network: colour network.
        config: descriptor.
        seed: seed for weights, order and orientations.
        progress: called with (stage, done, total, note).

    Returns:
        The embedding, which recognizes the classes, and the samples of the held-out set: those of distractors have
        labels from the number of classes on.

    Raises:
        InputError: a mesh of a distractor is unreadable, or the loss is not finite.
        OSError: a file cannot be written.
    """
    config, classes = dataclasses.replace(config, homology="closed_form"), tuple(source.classes)
    others = build_samples(
        distractors.sources,
        directory,
        network,
        config,
        distractors.views,
        COPIES,
        seed,
        local_workers(distractors.workers),
        lambda done, total: progress("render distractors", done, total, ""),
    )
    fitted: list[dict[str, NDArray[Any]]] = []
    kept: list[dict[str, NDArray[Any]]] = []
    for index, shard in enumerate(source.shards):
        views, rng = source.read(index), np.random.default_rng([seed, index])
        mask = np.isin(views.view, held_out.get(shard.label, []))
        for rows, chunks in ((~mask, fitted), (mask, kept)):
            if rows.any():
                chunks.append(sample_views(views, rows, network, config, COPIES, rng))
        progress("describe for the embedding", index + 1, len(source.shards), "")
    is_held_out = others.label % HELD_OUT == 0
    # Labels of fitted distractors are consecutive.
    label = others.label - (others.label // HELD_OUT + 1) * ~is_held_out + len(classes)
    others = dataclasses.replace(others, label=label.astype(np.int32))
    fitted.append(others.fields(np.flatnonzero(~is_held_out)))
    kept.append(others.fields(np.flatnonzero(is_held_out)))
    embedding = fit_embedding(
        joined_samples(fitted, config),
        network,
        config,
        EmbeddingFit(epochs=distractors.epochs, seed=seed, networks=N_NETWORKS),
        progress=lambda done, total, loss: progress("fit embedding", done, total, f"loss {loss:.3f}"),
        classes=classes,
    )
    return embedding, joined_samples(kept, config)
