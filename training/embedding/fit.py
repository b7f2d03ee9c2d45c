"""Fit an embedding by a proxy loss: each object has a learned unit vector, to which its views should be most similar.

The loss is the cross-entropy of the scaled cosines between a view and all proxies, less a margin for the view's own
(Movshovitz-Attias et al., "No Fuss Distance Metric Learning Using Proxies", ICCV 2017; Wang et al., "CosFace", CVPR
2018). Views of a new object are compared with other views, not with proxies. The proxies of a run's classes also serve
as a classifier.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe_strips
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding, EmbeddingNetwork, EmbeddingSizes, class_cosines, color_features
from thor2_jax.types import Descriptors, Strips
from training.embedding.samples import Batch, Samples

__all__ = ["EmbeddingFit", "batch_descriptors", "fit_embedding"]

BASIS_SAMPLES = 2048
"""Samples whose colour embeddings determine the principal components."""


@dataclasses.dataclass(frozen=True)
class EmbeddingFit:
    """Options of a fit.

    Attributes:
        epochs: passes over the samples.
        batch_size: samples of a step.
        rate: learning rate of AdamW at the first step; it falls to 0 along a cosine.
        margin: subtracted from the cosine between a view and its own proxy.
        seed: seed for weights, proxies, sample order and dropout.
        networks: number of networks, fitted one after the other from different weights. Only the first one embeds; all
            classify. Use 1 without classes.

    Raises:
        InputError: a value is out of range.
    """

    epochs: int = 10
    batch_size: int = 256
    rate: float = 2e-3
    margin: float = 0.12
    seed: int = 0
    networks: int = 1

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch_size - 1, self.networks) < 1 or not (self.rate > 0 and 0 <= self.margin < 1):
            raise InputError(
                f"{self}; expected at least 1 epoch, 1 network, batches of at least 2, a positive rate and a margin "
                "in [0, 1)"
            )


def batch_descriptors(
    length: jax.Array, color: jax.Array, network: ColorNetwork, config: DescriptorConfig
) -> Descriptors:
    """Return the descriptors of the strips of a batch; `length` and `color` are fields of `Batch`."""
    length = length.astype(jnp.float32)
    strips = Strips(
        low=jnp.zeros_like(length),
        high=length,
        occupied=length > 0,  # a strip of one point has no persistence, so its pair adds nothing to the image
        color=color.astype(jnp.float32),
        overflow=jnp.zeros(len(length), jnp.int32),
    )
    return describe_strips(strips, network, config)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _color_features(network: ColorNetwork, config: DescriptorConfig, batch: Batch) -> jax.Array:
    return color_features(batch_descriptors(batch.length, batch.color, network, config).embeddings)


def _color_basis(
    samples: Samples, network: ColorNetwork, config: DescriptorConfig, size: int, batch_size: int
) -> NDArray[np.float32]:
    """Return the principal components [F, size] of the colour features, not centred: projections keep cosines."""
    rows = np.arange(len(samples))[:: max(1, len(samples) // BASIS_SAMPLES)][:BASIS_SAMPLES]
    rows = np.resize(rows, -(-len(rows) // batch_size) * batch_size)
    features = np.concatenate(
        [_color_features(network, config, samples.take(chunk)) for chunk in rows.reshape(-1, batch_size)]
    )
    variances, vectors = np.linalg.eigh(features @ features.T)
    largest = slice(-1, -size - 1, -1)
    basis = features.T @ (vectors[:, largest] / np.sqrt(np.maximum(variances[largest], 1e-6)))
    return np.pad(basis, ((0, 0), (0, size - basis.shape[1])))


@functools.cache  # equal optimizers share the compiled step
def _adamw(rate: float, n_steps: int) -> Any:
    return optax.adamw(optax.cosine_decay_schedule(rate, n_steps), weight_decay=1e-3)


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3, 4), donate_argnums=5)
def _step(
    graph: Any, optimizer: Any, margin: float, network: ColorNetwork, config: DescriptorConfig, state: Any, batch: Batch
) -> tuple[Any, jax.Array]:
    """Make one step and return the next state and the loss before it."""
    parameters, rest, moments, key = state
    key, dropout = jax.random.split(key)
    descriptors = batch_descriptors(batch.length, batch.color, network, config)

    def loss_of(parameters: Any) -> Any:
        model = nnx.merge(graph, parameters, rest, copy=True)
        learned = model.learned(descriptors, batch.statistics, train=True, rngs=nnx.Rngs(dropout=dropout))
        cosines = class_cosines(learned, model.proxies[...])
        own = jax.nn.one_hot(batch.label, cosines.shape[1])
        logits = jnp.exp(model.log_scale[...]) * (cosines - margin * own)
        loss = optax.softmax_cross_entropy_with_integer_labels(logits, batch.label).mean()
        return loss, nnx.state(model, nnx.Not(nnx.Param))

    (loss, rest), gradients = jax.value_and_grad(loss_of, has_aux=True)(parameters)
    updates, moments = optimizer.update(gradients, moments, parameters)
    return (optax.apply_updates(parameters, updates), rest, moments, key), loss


def fit_embedding(
    samples: Samples,
    network: ColorNetwork,
    config: DescriptorConfig,
    options: EmbeddingFit,
    sizes: EmbeddingSizes | None = None,
    progress: Callable[[int, int, float], object] = lambda epoch, epochs, loss: None,
    classes: tuple[str, ...] = (),
) -> Embedding:
    """Fit an embedding; on the same machine, equal arguments give equal weights.

    Args:
        samples: of at least two objects.
        network: colour network of the samples.
        config: descriptor of the samples.
        options: of the fit.
        sizes: of the network.
        progress: called after each epoch with (epochs done, epochs of all networks, mean loss).
        classes: names of the first objects, which the embedding also recognizes: their proxies, and those of the other
            objects as distractors, are kept. None by default: the proxies are discarded.

    Raises:
        InputError: there are fewer samples than in a batch, or the loss is not finite.
    """
    if len(samples) < options.batch_size:
        raise InputError(f"there are {len(samples)} samples; expected at least {options.batch_size}; add views")
    n_objects = int(samples.label.max()) + 1
    embedding = Embedding.create(config, network, sizes, options.seed, classes, n_objects - len(classes))
    basis = _color_basis(samples, network, embedding.config, embedding.sizes.color, options.batch_size)
    embedding.model.color_basis[...] = jnp.asarray(basis)
    models = []
    for number in range(options.networks):
        seed, model = options.seed, embedding.model
        if number:
            seed = int(np.random.SeedSequence([options.seed, number]).generate_state(1)[0])
            model = embedding.create_further(seed)

        def report_epoch(epoch: int, loss: float, before: int = number * options.epochs) -> None:
            progress(before + epoch, options.networks * options.epochs, loss)

        models.append(_fit_network(model, embedding, samples, dataclasses.replace(options, seed=seed), report_epoch))
    fitted = dataclasses.replace(embedding, model=models[0], further=tuple(models[1:]))
    return fitted if classes else fitted.without_proxies()


def _fit_network(
    model: EmbeddingNetwork,
    embedding: Embedding,
    samples: Samples,
    options: EmbeddingFit,
    progress: Callable[[int, float], object],
) -> EmbeddingNetwork:
    """Fit a network of an embedding; `progress` is called after each epoch with (epochs done, mean loss)."""
    n_steps = len(samples) // options.batch_size
    split: Any = nnx.split(model, nnx.Param, ...)
    graph, parameters, rest = split
    optimizer = _adamw(options.rate, n_steps * options.epochs)
    state = parameters, rest, optimizer.init(parameters), jax.random.key(options.seed)
    for epoch in range(options.epochs):
        order = np.random.default_rng([options.seed, epoch]).permutation(len(samples))
        total = jnp.zeros(())
        for rows in order[: n_steps * options.batch_size].reshape(n_steps, -1):
            batch = samples.take(rows)
            state, loss = _step(graph, optimizer, options.margin, embedding.network, embedding.config, state, batch)
            total += loss
        mean = float(total) / n_steps
        if not np.isfinite(mean):
            raise InputError(f"the loss is {mean} in epoch {epoch + 1}; expected a finite one; lower the rate")
        progress(epoch + 1, mean)
    fitted: EmbeddingNetwork = nnx.merge(graph, state[0], state[1])
    return fitted
