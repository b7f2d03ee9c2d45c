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
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding, EmbeddingSizes
from thor2_jax.types import Cloud
from training.embedding.fit import fit_embedding, reference_views
from training.embedding.samples import Samples, sample_clouds
from training.embedding.sampling import AUGMENTATIONS, ObjectSource, build_samples, render_clouds, stored_samples
from training.fitting.loop import Checkpoints, EpochMetrics
from training.objects.meshes import load_mesh
from training.storage.jobs import Progress, cache_directory, of_stage
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
        InputError: there are fewer than ten distractors.
    """

    procedural: int = 1500
    meshes: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    views: int = 8
    epochs: int = 8
    networks: int = 5
    workers: int = 1

    def __post_init__(self) -> None:
        count = self.procedural + len(self.meshes)
        if count < HELD_OUT:
            raise InputError(f"distractors: there are {count} objects; expected at least {HELD_OUT}; give more")

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
        return build_samples(sources, network, config, distractors.views, COPIES, SEED, pool, show)

    job = {
        "descriptor_version": DESCRIPTOR_VERSION,
        "descriptor_config": dataclasses.asdict(config),
        "color_network": network.fingerprint,
        "objects": objects,
        "views": distractors.views,
        "copies": COPIES,
        "seed": SEED,
        "augmentations": AUGMENTATIONS.record(),
    }
    samples = stored_samples(job, cache_directory("distractors") or directory, build)
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
        directory: for the samples of the distractors, from which an interrupted training resumes if there is no cache.
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
    fitted: list[Samples] = []
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
    others = others.select(np.flatnonzero(others.label % HELD_OUT))
    # The labels of the fitted distractors follow those of the classes without gaps.
    label = (len(classes) + others.label - others.label // HELD_OUT - 1).astype(np.int32)
    samples = Samples.concatenated([*fitted, dataclasses.replace(others, label=label)])
    # Samples are strips in random orientations, without points: the looks need the clouds, which are rendered again.
    objects = dict(list(enumerate(distractors.sources))[::HELD_OUT])
    rendered = render_clouds(objects, distractors.views, SEED)
    kept += [(len(classes) + index, cloud) for index, cloud in rendered]
    progress(DESCRIBE, len(source.shards) + 1, len(source.shards) + 1, "")

    def show(done: int, total: int, metrics: EpochMetrics) -> None:
        progress(FIT, done, total, metrics.describe(distractors.epochs))

    embedding = fit_embedding(
        samples,
        network,
        config,
        distractors.epochs,
        SIZES,
        networks=distractors.networks,
        classes=classes,
        seed=seed,
        progress=show,
        checkpoints=checkpoints,
        epoch_done=epoch_done,
    )
    embedding = dataclasses.replace(embedding, references=reference_views(embedding, samples, seed))
    return embedding, kept
