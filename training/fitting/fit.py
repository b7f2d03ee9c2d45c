"""Fit one classifier (paper, section "Training"): Adam at 1e-2 and then 1e-3, categorical cross-entropy.

Two trainings with the same seed, views and options have the same folds, initial weights, sample order and dropout. On
the same machine, with the same library versions and number of CPU devices, their weights and metrics are equal bit for
bit, also if one of them was interrupted; only `samples_per_second` differs. On other hardware, on accelerators or with
another number of devices, floating-point sums are rounded differently, and the weights are close but not equal.
"""

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.model.classifier import MLP
from thor2_jax.model.run_directory import input_size
from training.fitting.loop import Checkpoints, EpochMetrics, FitOptions, Steps, run_epochs, wait_for_all
from training.fitting.samples import Batch, Samples
from training.fitting.steps import (
    FitContext,
    FitState,
    count_correct,
    initial_state,
    replicate,
    scale_inputs,
    shard_batch,
    train_step,
)

__all__ = ["check_batch_size", "fit"]

SCALE_SAMPLES = 1024
"""Approximate number of training samples that determine the input scaling."""


def check_batch_size(batch_size: int, mesh: Mesh) -> None:
    """Raise InputError unless the batch divides evenly among the devices."""
    if batch_size % mesh.devices.size:
        raise InputError(f"batch_size is {batch_size}; it must be a multiple of the {mesh.devices.size} devices")


def fit(
    samples: Samples,
    context: FitContext,
    options: FitOptions,
    checkpoints: Checkpoints,
    held_out: NDArray[np.bool_] | None = None,
    progress: Callable[[int, int, EpochMetrics], object] = lambda done, total, metrics: None,
    epoch_done: Callable[[EpochMetrics], object] = lambda metrics: None,
    rows: NDArray[np.intp] | None = None,
) -> tuple[MLP, int]:
    """Train the MLP of one feature, or resume from the last checkpoint.

    Samples are expanded to descriptors on the devices, one batch at a time, in closed form (equal to gudhi's values).

    Args:
        samples: training samples and held-out set; with several processes, the same in each.
        context: feature, colour network, descriptor and devices.
        options: epochs, learning rates, batch size and seed.
        checkpoints: of this fit only; written after each epoch.
        held_out: [M], True for samples of the held-out set; by default there is none.
        progress: called with (steps done, total steps, metrics of the epoch so far), for some of the steps.
        epoch_done: called after each epoch, before its checkpoint is written.
        rows: the samples that take part; by default all.

    Returns:
        The classifier of the best epoch, and that epoch's number: the one with the highest held-out accuracy or,
        without a held-out set, with the lowest training loss.

    Raises:
        InputError: There are fewer than two training samples, the batch does not divide among the devices, a checkpoint
            is unreadable, or the loss is not finite (the last checkpoint stays).
        OSError: A checkpoint cannot be written; the previous one stays.
    """
    context = dataclasses.replace(context, config=dataclasses.replace(context.config, homology="closed_form"))
    n_devices, rows = context.mesh.devices.size, np.arange(len(samples)) if rows is None else rows
    is_held_out = np.zeros(len(rows), bool) if held_out is None else held_out[rows]
    train_rows, held_out_rows = rows[~is_held_out], rows[is_held_out]
    check_batch_size(options.batch_size, context.mesh)
    least = max(2, n_devices)
    if len(train_rows) < least:
        raise InputError(
            f"there are {len(train_rows)} samples to train on; at least {least} are required; render more views"
        )
    batch_size = min(options.batch_size, len(train_rows) // n_devices * n_devices)
    steps = Steps(options.epochs, len(train_rows) // batch_size, batch_size)
    n_inputs = input_size(context.feature, context.config, context.network.n_regions)
    model = MLP(n_inputs, len(samples.classes), rngs=nnx.Rngs(options.seed))
    chosen = samples.take(train_rows[:: max(1, len(train_rows) // SCALE_SAMPLES)][:SCALE_SAMPLES])
    model.input_scale[...] = scale_inputs(chosen, context.feature, context.network, context.config)
    graph, initial = initial_state(model)

    def batches(rows: NDArray[np.intp]) -> Iterator[Batch]:
        """Yield batches on the devices; this process gathers its own chunk of each."""
        chunk = batch_size // jax.process_count()
        for first in range(jax.process_index() * chunk, len(rows), batch_size):
            yield shard_batch(samples.take(rows[first : first + chunk]), context.mesh)

    def epoch(number: int) -> Iterator[Batch]:
        # The order is drawn from seed and epoch, so that a resumed fit needs no generator state.
        order = np.random.default_rng((options.seed, number)).permutation(train_rows)
        return batches(order[: steps.of_epoch * batch_size])

    def step(state: FitState, number: int, batch: Batch) -> tuple[FitState, tuple[jax.Array, jax.Array]]:
        is_second_half = number // steps.of_epoch + 1 > (options.epochs + 1) // 2
        rate = np.float32(options.learning_rates[is_second_half])
        return train_step(context, graph, state, batch, rate, np.uint32(options.seed), np.uint32(number))

    def held_out_accuracy(state: FitState) -> float | None:
        if not len(held_out_rows):
            return None
        padded = np.resize(held_out_rows, len(held_out_rows) + -len(held_out_rows) % batch_size)
        remaining = range(len(held_out_rows), 0, -batch_size)
        correct = [
            count_correct(context, graph, state, batch, np.int32(n))
            for n, batch in zip(remaining, batches(padded), strict=True)
        ]
        return float(np.sum(jax.device_get(correct)) / len(held_out_rows))

    state = run_epochs(
        context.feature,
        initial,
        steps,
        epoch,
        step,
        checkpoints,
        progress=progress,
        epoch_done=epoch_done,
        held_out_accuracy=held_out_accuracy,
        place=lambda state: replicate(state, context.mesh),
    )
    wait_for_all(f"fitted {context.feature}")
    best = jax.tree.map(jnp.asarray, checkpoints.best(state))
    return nnx.merge(graph, best.params, best.rest), checkpoints.best_epoch
