"""One step of training and one of measuring, over all devices of a mesh.

Samples are spread over the devices, weights are the same on all, and means over the batch (loss, gradients, batch
normalization) are means over the whole of it.
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
from thor2_jax.descriptor.color_membership import region_sets
from thor2_jax.descriptor.describe import describe_strips
from thor2_jax.descriptor.sharding import BATCH_AXIS
from thor2_jax.recognition.classifier import MLP, Feature, feature_of
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
        rest: batch statistics, and the fixed input scale.
        optimizer: state of Adam.
    """

    params: Any
    rest: Any
    optimizer: Any


class FitContext(NamedTuple):
    """What is fixed in a fit; static under jit.

    Attributes:
        graph: the classifier without its arrays, as `nnx.split` gives it.
        feature: what it reads.
        network: gives the colour regions and their similarity.
        config: of the samples; diagrams are to be made in closed form.
        mesh: from `batch_mesh`.
    """

    graph: Any
    feature: Feature
    network: ColorNetwork
    config: DescriptorConfig
    mesh: Mesh


def initial_state(model: MLP) -> tuple[Any, FitState]:
    """The classifier's graph, and the state before the first step."""
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
    """Descriptors of the samples of a batch."""
    return describe_strips(expand(batch, region_sets(network).weights, config), network, config)


def _everywhere(tree: Any, mesh: Mesh) -> Any:
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, PartitionSpec()))


@partial(jax.jit, static_argnums=0, donate_argnums=1)
def train_step(
    context: FitContext, state: FitState, batch: Batch, rate: ArrayLike, seed: ArrayLike, step: ArrayLike
) -> tuple[FitState, tuple[jax.Array, jax.Array]]:
    """One step of Adam.

    Args:
        context: static.
        state: used up.
        batch: spread over the devices.
        rate: step size.
        seed: of dropout.
        step: number of the step; dropout is drawn from it and the seed.

    Returns:
        The state after it, and the batch's loss and accuracy before it.
    """
    x = feature_of(describe_batch(batch, context.network, context.config), context.feature)
    key = jax.random.fold_in(jax.random.key(seed), step)

    def loss_of(params: Any) -> Any:
        model = nnx.merge(context.graph, params, state.rest, copy=True)
        logits = model(x, train=True, rngs=nnx.Rngs(dropout=key))
        loss = optax.softmax_cross_entropy_with_integer_labels(logits, batch.label).mean()
        return loss, ((logits.argmax(axis=-1) == batch.label).mean(), nnx.state(model, nnx.Not(nnx.Param)))

    (loss, (accuracy, rest)), gradients = jax.value_and_grad(loss_of, has_aux=True)(state.params)
    updates, optimizer = optax.adam(rate).update(gradients, state.optimizer, state.params)
    after = FitState(optax.apply_updates(state.params, updates), rest, optimizer)
    return _everywhere((after, (loss, accuracy)), context.mesh)


@partial(jax.jit, static_argnums=0)
def count_correct(context: FitContext, state: FitState, batch: Batch, count: ArrayLike) -> jax.Array:
    """How many of the first `count` samples of a batch are named rightly."""
    model = nnx.merge(context.graph, state.params, state.rest, copy=True)
    logits = model(feature_of(describe_batch(batch, context.network, context.config), context.feature))
    right = (logits.argmax(axis=-1) == batch.label) & (jnp.arange(len(logits)) < count)
    return _everywhere(right.sum(), context.mesh)


@partial(jax.jit, static_argnums=(1, 2, 3))
def scale_inputs(sample: Batch, feature: Feature, network: ColorNetwork, config: DescriptorConfig) -> jax.Array:
    """1 / root mean square of each block of the descriptor (image, embedding) over a sample, for its entries: [F]."""
    found = describe_batch(sample, network, config)
    block = dataclasses.replace(
        found,
        images=jnp.full(found.images.shape[1:], jnp.sqrt((found.images**2).mean()))[None],
        embeddings=jnp.full(found.embeddings.shape[1:], jnp.sqrt((found.embeddings**2).mean()))[None],
        overflow=found.overflow[:1],
    )
    size = feature_of(block, feature)[0]
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1), 1)
