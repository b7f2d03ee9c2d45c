"""Fitting one classifier (paper, section "Training"): Adam, 1e-2 then 1e-3, categorical cross-entropy."""

import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.sharding import batch_mesh
from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import MLP, Feature
from thor2_jax.recognition.run_directory import input_size
from training.fitting.checkpoints import Checkpoints
from training.fitting.options import EpochMetrics, FitOptions
from training.fitting.samples import Batch, Samples
from training.fitting.steps import (
    FitContext,
    count_correct,
    initial_state,
    replicate,
    scale_inputs,
    shard_batch,
    train_step,
)

__all__ = ["check_batch_size", "fit"]


STEPS_IN_FLIGHT = 2
"""Steps handed to the devices before the first of them has to be done: the host gathers batches meanwhile."""

SCALE_SAMPLES = 1024
"""About so many training samples tell the scale of the inputs."""


T = TypeVar("T")


def _delayed(items: Iterable[T]) -> Iterator[T]:
    """The items, each after STEPS_IN_FLIGHT more have been begun."""
    waiting: deque[T] = deque()
    for item in items:
        waiting.append(item)
        if len(waiting) > STEPS_IN_FLIGHT:
            yield waiting.popleft()
    yield from waiting


def check_batch_size(batch_size: int, mesh: Mesh) -> None:
    """Refuse, with an InputError, a batch that does not divide among the devices."""
    if batch_size % mesh.devices.size:
        raise InputError(f"batch_size is {batch_size}; it must be a multiple of the {mesh.devices.size} devices")


def fit(
    samples: Samples,
    network: ColorNetwork,
    config: DescriptorConfig,
    feature: Feature,
    options: FitOptions,
    checkpoints: Checkpoints,
    held_out: NDArray[np.bool_] | None = None,
    progress: Callable[[int, int, EpochMetrics], object] = lambda done, total, figures: None,
    epoch_done: Callable[[EpochMetrics], object] = lambda figures: None,
    mesh: Mesh | None = None,
) -> tuple[MLP, int]:
    """Train the MLP of one feature, on from the last checkpoint if there is one.

    Samples are expanded to descriptors a batch at a time, on the devices, in closed form (the same values as gudhi's).
    A fit that was stopped and goes on ends with the same weights, bit for bit, as one that was not.

    Args:
        samples: those to train on and those held out.
        network: its similarity Delta enters the colour embeddings.
        config: as the samples were built with. Static.
        feature: what the classifier reads.
        options: epochs, step sizes, batch size, seed.
        checkpoints: of this fit alone; written after each epoch.
        held_out: [M], samples to measure on and not to train on; by default none.
        progress: called after each step with steps done, steps in all, figures so far.
        epoch_done: called after each epoch, before its checkpoint is written.
        mesh: devices to train on, from `sharding.batch_mesh`; by default all of all processes. Processes must
            be given the same samples; each expands its part of every batch.

    Returns:
        The classifier of the best epoch, and that epoch's number: the greatest accuracy on the samples held out, or,
        where there are none, the smallest training loss.

    Raises:
        InputError: fewer than two samples to train on, a batch that does not divide among the devices, a
            checkpoint that cannot be read, or a loss that is not finite: then the last checkpoint stays.
        OSError: a checkpoint cannot be written; the one before stays.
    """
    mesh = mesh or batch_mesh()
    rows = np.arange(len(samples))
    train_rows, test_rows = (rows, rows[:0]) if held_out is None else (rows[~held_out], rows[held_out])
    check_batch_size(options.batch_size, mesh)
    least = max(2, mesh.devices.size)
    if len(train_rows) < least:
        raise InputError(f"there are {len(train_rows)} samples to train on; at least {least} are needed")
    batch_size = min(options.batch_size, len(train_rows) // mesh.devices.size * mesh.devices.size)
    n_steps = len(train_rows) // batch_size
    config = dataclasses.replace(config, homology="closed_form")
    n_inputs = input_size(feature, config, network.n_regions)
    model = MLP(n_inputs, len(samples.classes), rngs=nnx.Rngs(options.seed))
    sample = samples.take(train_rows[:: max(1, len(train_rows) // SCALE_SAMPLES)][:SCALE_SAMPLES])
    model.input_scale[...] = scale_inputs(sample, feature, network, config)
    graph, state = initial_state(model)
    context = FitContext(graph, feature, network, config, mesh)
    if checkpoints.last_epoch:
        state = checkpoints.last(state)
    state = replicate(state, mesh)

    def batches(rows: NDArray[np.intp]) -> Iterator[Batch]:
        part = batch_size // jax.process_count()
        for first in range(jax.process_index() * part, len(rows), batch_size):
            yield shard_batch(samples.take(rows[first : first + part]), mesh)

    def train(epoch: int) -> Iterator[tuple[jax.Array, jax.Array]]:
        nonlocal state
        # Drawn anew from seed and epoch: to go on, no state of a generator is needed.
        order = np.random.default_rng((options.seed, epoch)).permutation(train_rows)[: n_steps * batch_size]
        rate = np.float32(options.learning_rates[epoch > (options.epochs + 1) // 2])
        for step, batch in enumerate(batches(order), (epoch - 1) * n_steps):
            state, figures = train_step(context, state, batch, rate, np.uint32(options.seed), np.uint32(step))
            yield figures

    def held_out_accuracy() -> float | None:
        if not len(test_rows):
            return None
        full = np.resize(test_rows, len(test_rows) + -len(test_rows) % batch_size)
        left = range(len(test_rows), 0, -batch_size)
        right = [
            count_correct(context, state, batch, np.int32(n)) for n, batch in zip(left, batches(full), strict=True)
        ]
        return float(np.sum(jax.device_get(right)) / len(test_rows))

    for epoch in range(checkpoints.last_epoch + 1, options.epochs + 1):
        total = np.zeros(2)
        for done, figures in enumerate(_delayed(train(epoch)), 1):
            total += jax.device_get(figures)
            loss, accuracy = (total / done).tolist()
            if not math.isfinite(loss):
                raise InputError(
                    f"the training loss of {feature} is {loss} in epoch {epoch}; try a smaller learning rate"
                )
            if done == 1:
                start = time.perf_counter()
            rate = (done - 1) * batch_size / max(time.perf_counter() - start, 1e-9)
            found = EpochMetrics(epoch, loss, accuracy, rate)
            progress((epoch - 1) * n_steps + done, n_steps * options.epochs, found)
        found = dataclasses.replace(found, held_out_accuracy=held_out_accuracy())
        epoch_done(found)
        checkpoints.save(epoch, state, -loss if found.held_out_accuracy is None else found.held_out_accuracy)
    best = jax.tree.map(jnp.asarray, checkpoints.best(state))
    return nnx.merge(graph, best.params, best.rest), checkpoints.best_epoch
