"""The embedding of a run, fitted on views of its classes and of distractors: objects that are none of them.

Distractors are procedural objects, or meshes of other objects. They teach the embedding what is unknown; a tenth of
them is held out, so that the confidence is calibrated on unknown objects that no network was fitted on.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.networks import EmbeddingSizes
from thor2_jax.types import Cloud
from training.embedding.fit import fit_embedding, reference_views
from training.embedding.samples import (
    AUGMENTATIONS,
    Samples,
    build_samples,
    render_clouds,
    sample_clouds,
    stored_samples,
)
from training.fitting.loop import Checkpoints, EpochMetrics
from training.fitting.protocol import ONE_HELD_OUT_OF, STAGES, Distractors, Protocol
from training.objects.meshes import load_mesh
from training.storage.jobs import Progress, cache_directory, of_stage
from training.storage.workers import local_workers
from training.views.normalized_views import ViewSource
from training.views.render_job import mesh_digest

__all__ = ["fit_run_embedding"]

COPIES = 2
"""Samples of each view, in random orientations."""

SEED = 0
"""Seed of the distractors of all runs, which therefore share their samples in the user's cache."""

SIZES = EmbeddingSizes(cell=12, hidden=(256, 192))
"""Sizes of each network; several small networks are steadier than fewer large ones."""

RENDER, DESCRIBE, FIT = STAGES


def _distractor_samples(
    distractors: Distractors, directory: Path, network: ColorNetwork, config: DescriptorConfig, progress: Progress
) -> Samples:
    """Render and sample the distractors, unless the user's cache or the directory has their samples."""
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
    cache = cache_directory("distractors")
    samples = stored_samples(job, [directory] if cache is None else [cache, directory], build)
    progress(RENDER, len(sources), len(sources), "")
    return samples


def fit_run_embedding(
    source: ViewSource,
    held_out: Mapping[int, NDArray[np.integer[Any]]],
    settings: Protocol,
    directory: Path,
    progress: Progress,
    checkpoints: Checkpoints,
    epoch_done: Callable[[EpochMetrics], object],
) -> tuple[Embedding, list[tuple[int, Cloud]]]:
    """Fit the embedding of a run.

    Args:
        source: normalized views of the classes.
        held_out: label -> indices of the views of the held-out set.
        settings: those of the run, with distractors.
        directory: for the samples of the distractors, if the user's cache cannot be used.
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
    distractors, network, seed = settings.distractors, settings.network, settings.fit.seed
    assert distractors is not None
    config, classes = dataclasses.replace(settings.config, homology="closed_form"), tuple(source.classes)
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
    others = others.select(np.flatnonzero(others.label % ONE_HELD_OUT_OF))
    # The labels of the fitted distractors follow those of the classes without gaps.
    label = (len(classes) + others.label - others.label // ONE_HELD_OUT_OF - 1).astype(np.int32)
    samples = Samples.concatenated([*fitted, dataclasses.replace(others, label=label)])
    # Samples are strips in random orientations, without points: the looks need the clouds, which are rendered again.
    objects = dict(list(enumerate(distractors.sources))[::ONE_HELD_OUT_OF])
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
