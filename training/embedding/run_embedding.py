"""The embedding of a run, fitted on views of its classes and of distractors: objects that are none of them.

Distractors are procedural objects, or meshes of other objects. They teach the embedding what is unknown; a tenth of
them is held out, so that the confidence is calibrated on unknown objects that no network was fitted on.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding, EmbeddingSizes
from thor2_jax.types import Cloud
from training.embedding.fit import EmbeddingFit, fit_embedding, reference_views
from training.embedding.samples import Samples, joined_samples, sample_clouds
from training.embedding.sampling import (
    ObjectSource,
    ViewTask,
    build_samples,
    cached_samples,
    render_clouds,
    sampling_job,
)
from training.fitting.loop import Checkpoints, EpochMetrics
from training.objects.meshes import load_mesh
from training.storage.jobs import JOB_FILE, Progress, of_stage
from training.storage.workers import local_workers
from training.views.normalized_views import ViewSource
from training.views.render_job import mesh_digest

__all__ = ["STAGES", "Distractors", "fit_run_embedding"]

COPIES = 2
"""Samples of each view, in random orientations."""

SEED = 0
"""Seed of the distractors of all runs, which therefore share their samples in the user's cache."""

SIZES = EmbeddingSizes(cell=12, hidden=(256, 192))
"""Sizes of each network; several small networks are steadier than fewer large ones."""

RENDER, DESCRIBE, FIT = STAGES = ("render distractors", "describe for the embedding", "fit networks")
"""Names of the stages, for the progress."""

HELD_OUT = 10
"""One in this many distractors is held out."""


@dataclasses.dataclass(frozen=True)
class Distractors:
    """Objects that are none of the classes, and how the embedding is fitted on them and the classes.

    Attributes:
        procedural: number of procedural objects.
        meshes: name -> file of other objects.
        views: views of each distractor.
        epochs: passes over the samples.
        networks: number of networks in the embedding; docs/decisions.md says why there are several.
        workers: rendering processes; they do not affect the result.

    Raises:
        InputError: there are fewer than ten distractors, or a number is out of range.
    """

    procedural: int = 1500
    meshes: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    views: int = 8
    epochs: int = 8
    networks: int = 5
    workers: int = 1

    def __post_init__(self) -> None:
        count = self.procedural + len(self.meshes)
        if self.procedural < 0 or count < HELD_OUT or min(self.views, self.epochs, self.networks, self.workers) < 1:
            raise InputError(
                f"distractors: there are {count} objects with {self.views} views, {self.networks} networks and "
                f"{self.epochs} epochs; expected at least {HELD_OUT} objects, 1 view, 1 network and 1 epoch"
            )

    @property
    def sources(self) -> list[ObjectSource]:
        """The meshes and the procedural objects in a random order, always the same, so that both kinds are held out."""
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
        """All that determines the embedding, as JSON holds it."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self) if field.name != "workers"}
        return named | {"meshes": sorted(self.meshes)}


def _distractor_samples(
    distractors: Distractors, directory: Path, network: ColorNetwork, config: DescriptorConfig, progress: Progress
) -> Samples:
    """Render and sample the distractors, unless the user's cache has their samples."""
    sources = distractors.sources
    objects = [mesh_digest(load_mesh(source)) if isinstance(source, Path) else source for source in sources]

    def build() -> Samples:
        pool, show = local_workers(distractors.workers), of_stage(progress, RENDER)
        return build_samples(sources, directory, network, config, distractors.views, COPIES, SEED, pool, show)

    job = sampling_job(objects, network, config, distractors.views, COPIES, SEED)
    samples = cached_samples(job, build, resumes=(directory / JOB_FILE).is_file())
    progress(RENDER, len(sources), len(sources), "")
    return samples


def fit_run_embedding(
    source: ViewSource,
    held_out: Mapping[int, NDArray[np.integer[Any]]],
    distractors: Distractors,
    directory: Path,
    network: ColorNetwork,
    config: DescriptorConfig,
    seed: int,
    progress: Progress,
    checkpoints: Checkpoints | None = None,
    epoch_done: Callable[[EpochMetrics], object] = lambda metrics: None,
) -> tuple[Embedding, list[tuple[int, Cloud]]]:
    """Fit the embedding of a run.

    Args:
        source: normalized views of the classes.
        held_out: label -> indices of the views of the held-out set.
        distractors: the other objects.
        directory: for the samples of the distractors, from which an interrupted training resumes; unused if the
            user's cache has them.
        network: colour network.
        config: descriptor.
        seed: seed for weights, order and orientations of the views of the classes.
        progress: called with (stage, done, total, note).
        checkpoints: see `fit_embedding`.
        epoch_done: likewise.

    Returns:
        The embedding, which recognizes the classes, and label and cloud, in metres, of each view of the held-out set:
        those of distractors have labels from the number of classes on. The clouds have no rim and no boundary.

    Raises:
        InputError: a mesh of a distractor is unreadable, or the loss is not finite.
        OSError: a file cannot be written.
    """
    config, classes = dataclasses.replace(config, homology="closed_form"), tuple(source.classes)
    others = _distractor_samples(distractors, directory, network, config, progress)
    fitted: list[dict[str, NDArray[Any]]] = []
    kept: list[tuple[int, Cloud]] = []
    for index, shard in enumerate(source.shards):
        views, rng = source.read(index), np.random.default_rng([seed, index])
        is_kept = np.isin(views.view, held_out.get(shard.label, []))
        clouds = list(itertools.compress(views.clouds(), ~is_kept))
        if clouds:
            labels = [views.label] * len(clouds)
            fitted.append(sample_clouds(clouds, labels, network, config, COPIES, rng, are_normal=True))
        for xyz, rgb in itertools.compress(views.clouds(), is_kept):
            # A copy, since a slice would keep all views of the shard in memory.
            kept.append((views.label, (xyz / np.float32(config.sigma_s), rgb.copy())))
        progress(DESCRIBE, index + 1, len(source.shards) + 1, "")
    fitted.append(others.fields(np.flatnonzero(others.label % HELD_OUT)))
    label = fitted[-1]["label"]
    # The labels of the fitted distractors follow those of the classes without gaps.
    fitted[-1]["label"] = (len(classes) + label - label // HELD_OUT - 1).astype(np.int32)
    # Samples are strips in random orientations, without points: the looks need the clouds, which are rendered again.
    objects = dict(list(enumerate(distractors.sources))[::HELD_OUT])
    rendered = render_clouds(ViewTask(objects, distractors.views, SEED))
    kept += [(len(classes) + index, cloud) for index, cloud in rendered]
    progress(DESCRIBE, len(source.shards) + 1, len(source.shards) + 1, "")

    def show(done: int, total: int, metrics: EpochMetrics) -> None:
        progress(FIT, done, total, metrics.describe(distractors.epochs))

    samples = joined_samples(fitted, config)
    options = EmbeddingFit(epochs=distractors.epochs, seed=seed, networks=distractors.networks)
    embedding = fit_embedding(samples, network, config, options, SIZES, show, classes, checkpoints, epoch_done)
    embedding = dataclasses.replace(embedding, references=reference_views(embedding, samples, seed))
    return embedding, kept
