"""Fitting one classifier (paper, section "Training"): Adam, 1e-2 then 1e-3, categorical cross-entropy."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx

from colornet import ColorNetwork
from thor2_jax.classifier import MLP, Feature, feature_of
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor import describe_strips
from thor2_jax.errors import InputError
from thor2_jax.run_folder import input_size
from thor2_jax.types import Strips
from training.dataset import StripDataset

__all__ = ["EpochFigures", "FitOptions", "fit"]


MAX_SEED = 2**31 - 1
"""JAX takes a seed of 32 bits."""


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """How a classifier is fitted.

    Attributes:
        epochs: first half at `learning_rates[0]`, the rest at `learning_rates[1]`.
        learning_rates: Adam's two step sizes.
        batch_size: samples a step; what is left of an epoch after whole batches is left out (another draw each epoch).
        seed: of initial weights, order and dropout.

    Raises:
        InputError: a value out of its range, naming the field and the value.
    """

    epochs: int = 100
    learning_rates: tuple[float, float] = (1e-2, 1e-3)
    batch_size: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch_size", 2), ("seed", 0)):
            if type(getattr(self, name)) is not int or getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)!r}; it must be a whole number of at least {least}")
        if self.seed > MAX_SEED:
            raise InputError(f"seed is {self.seed}; it must be at most {MAX_SEED}")
        rates = self.learning_rates
        if len(rates) != 2 or not all(isinstance(rate, int | float) and 0 < rate < math.inf for rate in rates):
            raise InputError(f"learning_rates is {rates!r}; it must be two positive numbers")


@dataclasses.dataclass(frozen=True)
class EpochFigures:
    """Mean training loss and accuracy (with dropout) over one epoch, counted from 1."""

    epoch: int
    loss: float
    accuracy: float


def _input_scale(dataset: StripDataset, network: ColorNetwork, config: DescriptorConfig, feature: Feature) -> jax.Array:
    """1 / root mean square of each block of the descriptor (image, embedding), spread over its entries: [F]."""
    step = max(1, len(dataset) // 1024)
    sample = describe_strips(jax.tree.map(lambda a: jnp.asarray(a[::step][:1024]), dataset.strips), network, config)
    block = dataclasses.replace(
        sample,
        images=jnp.full(sample.images.shape[1:], jnp.sqrt((sample.images**2).mean()))[None],
        embeddings=jnp.full(sample.embeddings.shape[1:], jnp.sqrt((sample.embeddings**2).mean()))[None],
        overflow=sample.overflow[:1],
    )
    size = feature_of(block, feature)[0]
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)


def fit(
    dataset: StripDataset,
    network: ColorNetwork,
    config: DescriptorConfig,
    feature: Feature,
    options: FitOptions,
    progress: Callable[[EpochFigures], object] = lambda figures: None,
) -> MLP:
    """Train the MLP of one feature.

    Samples are expanded from strips to descriptors a batch at a time, on the device, in closed form (the same values as
    gudhi's).

    Args:
        dataset: training samples.
        network: its similarity Delta enters the colour embeddings.
        config: as the dataset was built with. Static.
        feature: what the classifier reads.
        options: epochs, step sizes, batch size, seed.
        progress: called after each epoch.

    Raises:
        InputError: fewer than two classes or two samples, or a loss that is not finite.
    """
    if len(dataset.classes) < 2:
        raise InputError(f"classes is {dataset.classes}; a classifier needs at least two")
    if len(dataset) < 2:
        raise InputError(f"dataset has {len(dataset)} samples; batch normalization needs at least two")
    batch_size = min(options.batch_size, len(dataset))
    config = dataclasses.replace(config, homology="closed_form")
    model = MLP(input_size(feature, config, network.n_regions), len(dataset.classes), rngs=nnx.Rngs(options.seed))
    model.input_scale[...] = _input_scale(dataset, network, config, feature)
    split: Any = nnx.split(model, nnx.Param, ...)
    graph, params, rest = split

    steps = len(dataset) // batch_size
    schedule = optax.piecewise_constant_schedule(
        options.learning_rates[0],
        {steps * ((options.epochs + 1) // 2): options.learning_rates[1] / options.learning_rates[0]},
    )
    optimizer = optax.adam(schedule)
    state = optimizer.init(params)

    @partial(jax.jit, donate_argnums=(0, 1, 2))
    def train_step(params: Any, rest: Any, state: Any, key: jax.Array, batch: Strips, labels: jax.Array) -> Any:
        x = feature_of(describe_strips(batch, network, config), feature)

        def loss_of(params: Any) -> Any:
            model = nnx.merge(graph, params, rest, copy=True)
            logits = model(x, train=True, rngs=nnx.Rngs(dropout=key))
            loss = optax.softmax_cross_entropy_with_integer_labels(logits, labels).mean()
            return loss, ((logits.argmax(axis=-1) == labels).mean(), nnx.state(model, nnx.Not(nnx.Param)))

        (loss, (accuracy, rest)), gradients = jax.value_and_grad(loss_of, has_aux=True)(params)
        updates, state = optimizer.update(gradients, state, params)
        return optax.apply_updates(params, updates), rest, state, loss, accuracy

    rng, key = np.random.default_rng(options.seed), jax.random.key(options.seed)
    for epoch in range(options.epochs):
        order = rng.permutation(len(dataset))
        totals = []
        for step in range(steps):
            chosen = np.sort(order[step * batch_size : (step + 1) * batch_size])
            batch = jax.tree.map(lambda a: a[chosen], dataset.strips)  # noqa: B023
            step_key = jax.random.fold_in(key, epoch * steps + step)
            params, rest, state, *figures = train_step(params, rest, state, step_key, batch, dataset.labels[chosen])
            totals.append(figures)
        loss, accuracy = np.mean(np.asarray(totals, np.float64), axis=0)
        if not np.isfinite(loss):
            raise InputError(
                f"the training loss of {feature} is {loss} in epoch {epoch + 1}; try a smaller learning rate"
            )
        progress(EpochFigures(epoch + 1, float(loss), float(accuracy)))
    return nnx.merge(graph, params, rest)
