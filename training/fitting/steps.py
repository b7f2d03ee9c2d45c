"""The compiled training and evaluation steps, data-parallel over the devices of a mesh.

Batches are sharded over the devices and weights are replicated; loss, gradients and batch normalization are means over
the whole batch.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from flax import nnx
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.typing import ArrayLike

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.describe import describe_strips
from thor2_jax.descriptor.sharding import BATCH_AXIS, batch_mesh
from thor2_jax.descriptor.slicing import region_sets
from thor2_jax.model.classifier import MLP, Feature, feature_of
from thor2_jax.types import Descriptors
from training.fitting.samples import Batch, expand

__all__ = [
    "FitState",
    "FitContext",
    "count_correct",
    "describe_batch",
    "initial_state",
    "replicate",
    "scale_inputs",
    "shard_batch",
    "train_step",
]


class FitState(NamedTuple):
    """All that training changes. A pytree.

    Attributes:
        params: weights.
        rest: batch statistics and the constant input scaling.
        optimizer: state of Adam.
    """

    params: Any
    rest: Any
    optimizer: Any


@dataclasses.dataclass(frozen=True)
class FitContext:
    """Constants of a fit; static under jit.

    Attributes:
        feature: which part of the descriptor the classifier reads.
        network: colour network; gives the colour regions and their similarity.
        config: descriptor, as the samples were built with.
        mesh: devices to train on, from `batch_mesh`; by default all devices of all processes.
    """

    feature: Feature
    network: ColorNetwork
    config: DescriptorConfig
    mesh: Mesh = dataclasses.field(default_factory=batch_mesh)


def initial_state(model: MLP) -> tuple[Any, FitState]:
    """Return the classifier's graph (the model without its arrays) and the state before the first step."""
    split: Any = nnx.split(model, nnx.Param, ...)
    graph, params, rest = split
    return graph, FitState(params, rest, optax.adam(0.0).init(params))


def shard_batch(batch: Batch, mesh: Mesh) -> Batch:
    """Move a batch to the devices of a mesh, split along the samples; each process gives its own chunk of the batch."""
    return _to_devices(batch, NamedSharding(mesh, PartitionSpec(BATCH_AXIS)))


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Move a pytree of host arrays to the devices of a mesh, the same on all of them."""
    return _to_devices(tree, NamedSharding(mesh, PartitionSpec()))


def _to_devices(tree: Any, sharding: NamedSharding) -> Any:
    return jax.tree.map(lambda a: jax.make_array_from_process_local_data(sharding, np.asarray(a)), tree)


def describe_batch(batch: Batch, network: ColorNetwork, config: DescriptorConfig) -> Descriptors:
    """Return the descriptors of the samples of a batch."""
    return describe_strips(expand(batch, region_sets(network).weights, config), network, config)


def _replicated(tree: Any, mesh: Mesh) -> Any:
    """Constrain the arrays to be replicated on all devices."""
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec()))


@partial(jax.jit, static_argnums=(0, 1), donate_argnums=2)
def train_step(
    context: FitContext, graph: Any, state: FitState, batch: Batch, rate: ArrayLike, seed: ArrayLike, step: ArrayLike
) -> tuple[FitState, tuple[jax.Array, jax.Array]]:
    """Make one step of Adam.

    Args:
        context: static.
        graph: the classifier without its arrays, from `initial_state`. Static.
        state: donated; not usable afterwards.
        batch: on the devices, from `shard_batch`.
        rate: learning rate.
        seed: seed for the dropout.
        step: number of the step; dropout is drawn from it and the seed.

    Returns:
        The next state, and the batch's loss and accuracy before the step.
    """
    x = feature_of(describe_batch(batch, context.network, context.config), context.feature)
    key = jax.random.fold_in(jax.random.key(seed), step)

    def loss_of(params: Any) -> Any:
        model = nnx.merge(graph, params, state.rest, copy=True)
        logits = model(x, train=True, rngs=nnx.Rngs(dropout=key))
        loss = optax.softmax_cross_entropy_with_integer_labels(logits, batch.label).mean()
        return loss, ((logits.argmax(axis=-1) == batch.label).mean(), nnx.state(model, nnx.Not(nnx.Param)))

    (loss, (accuracy, rest)), gradients = jax.value_and_grad(loss_of, has_aux=True)(state.params)
    updates, optimizer = optax.adam(rate).update(gradients, state.optimizer, state.params)
    after = FitState(optax.apply_updates(state.params, updates), rest, optimizer)
    return _replicated((after, (loss, accuracy)), context.mesh)


@partial(jax.jit, static_argnums=(0, 1))
def count_correct(context: FitContext, graph: Any, state: FitState, batch: Batch, count: ArrayLike) -> jax.Array:
    """Return how many of the first `count` samples of a batch are classified correctly."""
    model = nnx.merge(graph, state.params, state.rest, copy=True)
    logits = model(feature_of(describe_batch(batch, context.network, context.config), context.feature))
    correct = (logits.argmax(axis=-1) == batch.label) & (jnp.arange(len(logits)) < count)
    return _replicated(correct.sum(), context.mesh)


@partial(jax.jit, static_argnums=(1, 2, 3))
def scale_inputs(sample: Batch, feature: Feature, network: ColorNetwork, config: DescriptorConfig) -> jax.Array:
    """Return the input scaling [F]: 1 / root mean square over a batch, one value for images, one for embeddings."""
    descriptors = describe_batch(sample, network, config)
    images, embeddings = descriptors.images, descriptors.embeddings
    block = dataclasses.replace(
        descriptors,
        images=jnp.full(images.shape[1:], jnp.sqrt((images**2).mean()))[None],
        embeddings=jnp.full(embeddings.shape[1:], jnp.sqrt((embeddings**2).mean()))[None],
        overflow=descriptors.overflow[:1],
    )
    size = feature_of(block, feature)[0]
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
