"""Fit an embedding by a proxy loss: each object has a learned unit vector, to which its views should be most similar.

The loss is the cross-entropy of the scaled cosines between a view and all proxies. A margin is subtracted for the
view's own proxy (Movshovitz-Attias et al., "No Fuss Distance Metric Learning Using Proxies", ICCV 2017; Wang et al.,
"CosFace", CVPR 2018). Views of a new object are compared with other views, not with proxies. The proxies of a run's
classes also serve as a classifier.

Reference views of an embedding are chosen from the samples on which it was fitted.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax import DescriptorConfig, InputError
from thor2_jax.descriptor.looks import N_SCALARS, LookDescriptors, is_color
from thor2_jax.networks.embedding import BACKGROUND, Embedding, References
from thor2_jax.networks.networks import EmbeddingSizes, class_cosines, projected_features
from training.fitting.fit import FitState, network_step
from training.fitting.loop import Checkpoints, EpochMetrics, Steps, run_epochs
from training.fitting.samples import Batch, Samples, describe_batch

__all__ = ["RUN_SIZES", "fit_embedding"]

RUN_SIZES = EmbeddingSizes(cell=12, hidden=(256, 192))
"""Sizes of each network of a run; several small networks give steadier answers than fewer large networks."""

BASIS_SAMPLES = 2048
"""Number of samples whose features determine the principal components."""


BATCH_SIZE = 256
"""Number of samples per step."""

RATE = 2e-3
"""Learning rate of AdamW at the first step; it decays to 0 along a cosine."""

MARGIN = 0.12
"""Subtracted from the cosine between a view and its own proxy."""


@functools.partial(jax.jit, static_argnums=(1, 2))
def batch_looks(batch: Batch, network: ColorNetwork, config: DescriptorConfig) -> LookDescriptors:
    """Return the descriptors of the samples of a batch, one look each."""
    descriptors = describe_batch(batch, network, config)
    each, statistics = jax.tree.map(lambda a: a[:, None], (descriptors, jnp.asarray(batch.statistics)))
    return LookDescriptors(each, statistics)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _projected_features(version: int, network: ColorNetwork, config: DescriptorConfig, batch: Batch) -> jax.Array:
    descriptors = describe_batch(batch, network, config)
    return projected_features(descriptors, jnp.asarray(batch.statistics), version)


def _color_basis(
    samples: Samples, network: ColorNetwork, config: DescriptorConfig, sizes: EmbeddingSizes
) -> NDArray[np.float32]:
    """Return the principal components [F, C] of the projected features, without centring, to preserve cosines."""
    rows = np.arange(len(samples))[:: max(1, len(samples) // BASIS_SAMPLES)][:BASIS_SAMPLES]
    batches = samples.batches(rows, BATCH_SIZE, network, config)
    features = np.concatenate([_projected_features(sizes.version, network, config, batch) for batch in batches])
    variances, vectors = np.linalg.eigh(features @ features.T)
    size = sizes.color
    largest = slice(-1, -size - 1, -1)
    basis = features.T @ (vectors[:, largest] / np.sqrt(np.maximum(variances[largest], 1e-6)))
    return np.pad(basis, ((0, 0), (0, size - basis.shape[1])))


@functools.cache  # equal optimizers share the compiled step
def _adamw(n_steps: int) -> Any:
    return optax.adamw(optax.cosine_decay_schedule(RATE, n_steps), weight_decay=1e-3)


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3), donate_argnums=4)
def _step(
    graphs: tuple[Any, ...],
    optimizer: Any,
    network: ColorNetwork,
    config: DescriptorConfig,
    states: tuple[FitState, ...],
    batch: Batch,
    seen: jax.Array,
    keys: jax.Array,
) -> tuple[tuple[FitState, ...], jax.Array]:
    """Make one step of every network; return the next states, and the mean loss and accuracy [2] before the step."""
    descriptors = describe_batch(batch, network, config)

    def step(graph: Any, state: FitState, seen: jax.Array, key: jax.Array) -> tuple[FitState, jax.Array]:
        def outputs_of(model: Any) -> tuple[jax.Array, jax.Array]:
            statistics = batch.statistics[:, : len(seen)] * seen
            learned = model.learned(descriptors, statistics, train=True, rngs=nnx.Rngs(dropout=key))
            cosines = class_cosines(learned, model.proxies[...])
            own = jax.nn.one_hot(batch.label, cosines.shape[1])
            return jnp.exp(model.log_scale[...]) * (cosines - MARGIN * own), cosines

        after, metrics = network_step(graph, state, optimizer, batch.label, outputs_of)
        return after, jnp.stack(metrics)

    after, metrics = zip(*(step(*each) for each in zip(graphs, states, seen, keys, strict=True)), strict=True)
    return after, jnp.stack(metrics).mean(axis=0)


def fit_embedding(
    samples: Samples,
    network: ColorNetwork,
    config: DescriptorConfig,
    epochs: int,
    checkpoints: Checkpoints,
    sizes: EmbeddingSizes | None = None,
    progress: Callable[[int, int, EpochMetrics], object] = lambda done, total, metrics: None,
    classes: tuple[str, ...] = (),
    *,
    networks: int = 1,
    seed: int = 0,
) -> Embedding:
    """Fit an embedding with its reference views, or resume from the last checkpoint.

    On the same machine, equal arguments give equal weights, even if the fit was interrupted.

    Args:
        samples: samples of at least two objects.
        network: colour network of the samples.
        config: descriptor of the samples.
        epochs: passes over the samples.
        checkpoints: checkpoints of this fit only, written after each epoch.
        sizes: sizes of each network.
        progress: called with (steps done, total steps, metrics of the epoch so far), for some of the steps.
        classes: names of the first objects, which the embedding also recognizes. Their proxies are kept, and the
            proxies of the other objects as distractors. By default, there are no classes and proxies are discarded.
        networks: number of networks, fitted together on the same batches from different weights. The first network
            computes the embedding; all networks classify. Use 1 without classes.
        seed: seed for weights, proxies, sample order, dropout and the choice of the reference views.

    Raises:
        InputError: there are fewer samples than in a batch, the loss is not finite, or a checkpoint is unreadable.
        OSError: a checkpoint cannot be written; the previous one is kept.
    """
    if len(samples) < BATCH_SIZE:
        raise InputError(f"there are {len(samples)} samples; expected at least {BATCH_SIZE}; add views")
    n_objects = int(samples.label.max()) + 1
    embedding = Embedding.create(config, network, sizes, seed, classes, n_objects - len(classes))
    embedding.model.color_basis[...] = jnp.asarray(_color_basis(samples, network, embedding.config, embedding.sizes))
    further = [
        embedding.create_further(int(np.random.SeedSequence([seed, number]).generate_state(1)[0]))
        for number in range(1, networks)
    ]
    n_steps = len(samples) // BATCH_SIZE
    optimizer = _adamw(n_steps * epochs)
    graphs, states = zip(*(FitState.initial(model, optimizer) for model in (embedding.model, *further)), strict=True)
    # The other networks do not read the colour statistics, which differ most between renderings and cameras.
    seen = np.ones((networks, N_SCALARS + network.n_regions), np.float32)
    seen[1:, is_color(embedding.network.n_regions)] = 0

    def train_epoch(number: int, states: tuple[FitState, ...]) -> Iterator[tuple[tuple[FitState, ...], jax.Array]]:
        # Order and dropout depend only on seed and step, so that a resumed fit needs no generator state.
        order = np.random.default_rng([seed, number]).permutation(len(samples))[: n_steps * BATCH_SIZE]
        batches = samples.batches(order, BATCH_SIZE, network, config)
        for step, batch in enumerate(batches, (number - 1) * n_steps + 1):
            keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), step), networks)
            states, computed = _step(graphs, optimizer, embedding.network, embedding.config, states, batch, seen, keys)
            yield states, computed

    states = run_epochs(
        "the embedding",
        jax.tree.map(jnp.asarray, checkpoints.last(states)),
        Steps(epochs, n_steps, BATCH_SIZE),
        train_epoch,
        checkpoints,
        progress=progress,
    )
    models = [nnx.merge(graph, state.params, state.rest) for graph, state in zip(graphs, states, strict=True)]
    fitted = dataclasses.replace(embedding, model=models[0], further=tuple(models[1:]))
    fitted = fitted if classes else fitted.without_proxies()
    return dataclasses.replace(fitted, references=reference_views(fitted, samples, seed))


BACKGROUND_VIEWS = 1024
"""Number of reference views of distractors."""

VIEWS_OF_CLASS, CLASS_VIEWS = 192, 8192
"""Largest number of views per class, and of all classes together."""


def reference_views(embedding: Embedding, samples: Samples, seed: int) -> References:
    """Return the embedded reference views of an embedding.

    Args:
        embedding: the embedding.
        samples: the samples on which it was fitted; the first labels belong to its classes.
        seed: seed for the choice of the views.
    """
    rng, n_classes = np.random.default_rng(seed), len(embedding.classes)
    per_class = min(VIEWS_OF_CLASS, CLASS_VIEWS // max(n_classes, 1))
    chosen = [_choose(samples.label == label, per_class, rng) for label in range(n_classes)]
    rows = np.concatenate([*chosen, _choose(samples.label >= n_classes, BACKGROUND_VIEWS, rng)])
    described_by = embedding.network, embedding.config
    looks = (batch_looks(batch, *described_by) for batch in samples.batches(rows, BATCH_SIZE, *described_by))
    chunks = [embedding.embed_oriented(batch)[:, 0] for batch in looks]
    label = samples.label[rows]
    embedded, shown = np.concatenate(chunks)[: len(rows)], np.where(label < n_classes, label, BACKGROUND)
    return References(embedded.astype(np.float16), shown.astype(np.int32), embedding.classes)


def _choose(allowed: NDArray[np.bool_], count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    rows = np.flatnonzero(allowed)
    return np.sort(rng.permutation(rows)[:count])
