"""Fit one classifier (paper, section "Training"): Adam at 1e-2 and then 1e-3, categorical cross-entropy.

Two trainings with the same seed, views and options have the same folds, initial weights, sample order and dropout. On
the same machine, with the same library versions and number of CPU devices, their weights and metrics are equal bit for
bit, also if one of them was interrupted; only `samples_per_second` differs. On other hardware, on accelerators or with
another number of devices, floating-point sums are rounded differently, and the weights are close but not equal.
"""

import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax.sharding import Mesh
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import MLP
from thor2_jax.recognition.run_directory import input_size
from training.fitting.checkpoints import Checkpoints
from training.fitting.options import EpochMetrics, FitOptions
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

STEPS_IN_FLIGHT = 2
"""Steps dispatched to the devices before the first result is awaited: the host gathers batches meanwhile."""

SCALE_SAMPLES = 1024
"""Approximate number of training samples that determine the input scaling."""

T = TypeVar("T")


def _delayed(items: Iterable[T]) -> Iterator[T]:
    """Yield the items, each after the next STEPS_IN_FLIGHT have been requested."""
    waiting: deque[T] = deque()
    for item in items:
        waiting.append(item)
        if len(waiting) > STEPS_IN_FLIGHT:
            yield waiting.popleft()
    yield from waiting


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
) -> tuple[MLP, int]:
    """Train the MLP of one feature, or resume from the last checkpoint.

    Samples are expanded to descriptors on the devices, one batch at a time, in closed form (equal to gudhi's values).

    Args:
        samples: training samples and held-out set; with several processes, the same in each.
        context: feature, colour network, descriptor and devices.
        options: epochs, learning rates, batch size and seed.
        checkpoints: of this fit only; written after each epoch.
        held_out: [M], True for samples of the held-out set; by default there is none.
        progress: called after each step with (steps done, total steps, metrics of the epoch so far).
        epoch_done: called after each epoch, before its checkpoint is written.

    Returns:
        The classifier of the best epoch, and that epoch's number: the one with the highest held-out accuracy or,
        without a held-out set, with the lowest training loss.

    Raises:
        InputError: There are fewer than two training samples, the batch does not divide among the devices, a checkpoint
            is unreadable, or the loss is not finite (the last checkpoint stays).
        OSError: A checkpoint cannot be written; the previous one stays.
    """
    fitter = _Fitter.create(samples, context, options, held_out)
    if checkpoints.last_epoch:
        fitter.state = checkpoints.last(fitter.state)
    fitter.state = replicate(fitter.state, context.mesh)
    for epoch in range(checkpoints.last_epoch + 1, options.epochs + 1):
        metrics = fitter.train_epoch(epoch, progress)
        epoch_done(metrics)
        score = -metrics.loss if metrics.held_out_accuracy is None else metrics.held_out_accuracy
        checkpoints.save(epoch, fitter.state, score)
    best = jax.tree.map(jnp.asarray, checkpoints.best(fitter.state))
    return nnx.merge(fitter.graph, best.params, best.rest), checkpoints.best_epoch


@dataclasses.dataclass
class _Fitter:
    """A fit in progress: its samples, what is static, and the state that each step replaces."""

    samples: Samples
    context: FitContext
    options: FitOptions
    train_rows: NDArray[np.intp]
    held_out_rows: NDArray[np.intp]
    batch_size: int
    graph: Any
    state: FitState

    @classmethod
    def create(
        cls, samples: Samples, context: FitContext, options: FitOptions, held_out: NDArray[np.bool_] | None
    ) -> "_Fitter":
        """Split the samples, check the batch size and initialize the classifier; the state stays on the host."""
        context = dataclasses.replace(context, config=dataclasses.replace(context.config, homology="closed_form"))
        n_devices = context.mesh.devices.size
        rows = np.arange(len(samples))
        train_rows, held_out_rows = (rows, rows[:0]) if held_out is None else (rows[~held_out], rows[held_out])
        check_batch_size(options.batch_size, context.mesh)
        least = max(2, n_devices)
        if len(train_rows) < least:
            raise InputError(
                f"there are {len(train_rows)} samples to train on; at least {least} are required; render more views"
            )
        batch_size = min(options.batch_size, len(train_rows) // n_devices * n_devices)
        n_inputs = input_size(context.feature, context.config, context.network.n_regions)
        model = MLP(n_inputs, len(samples.classes), rngs=nnx.Rngs(options.seed))
        chosen = samples.take(train_rows[:: max(1, len(train_rows) // SCALE_SAMPLES)][:SCALE_SAMPLES])
        model.input_scale[...] = scale_inputs(chosen, context.feature, context.network, context.config)
        graph, state = initial_state(model)
        return cls(samples, context, options, train_rows, held_out_rows, batch_size, graph, state)

    @property
    def steps_per_epoch(self) -> int:
        return len(self.train_rows) // self.batch_size

    def batches(self, rows: NDArray[np.intp]) -> Iterator[Batch]:
        """Yield batches on the devices; this process gathers its own chunk of each."""
        chunk = self.batch_size // jax.process_count()
        for first in range(jax.process_index() * chunk, len(rows), self.batch_size):
            yield shard_batch(self.samples.take(rows[first : first + chunk]), self.context.mesh)

    def steps(self, epoch: int) -> Iterator[tuple[jax.Array, jax.Array]]:
        """Train one epoch and yield the loss and accuracy of each batch."""
        # The order is drawn from seed and epoch, so that a resumed fit needs no generator state.
        order = np.random.default_rng((self.options.seed, epoch)).permutation(self.train_rows)
        order = order[: self.steps_per_epoch * self.batch_size]
        rate = np.float32(self.options.learning_rates[epoch > (self.options.epochs + 1) // 2])
        seed = np.uint32(self.options.seed)
        for step, batch in enumerate(self.batches(order), (epoch - 1) * self.steps_per_epoch):
            self.state, metrics = train_step(self.context, self.graph, self.state, batch, rate, seed, np.uint32(step))
            yield metrics

    def train_epoch(self, epoch: int, progress: Callable[[int, int, EpochMetrics], object]) -> EpochMetrics:
        """Train one epoch and return its metrics.

        Raises:
            InputError: The loss is not finite.
        """
        total = np.zeros(2)
        n_steps = self.steps_per_epoch
        for done, batch_metrics in enumerate(_delayed(self.steps(epoch)), 1):
            total += jax.device_get(batch_metrics)
            loss, accuracy = (total / done).tolist()
            if not math.isfinite(loss):
                raise InputError(
                    f"the training loss of {self.context.feature} is {loss} in epoch {epoch}; it must be finite; try a "
                    "smaller learning rate"
                )
            if done == 1:
                start = time.perf_counter()
            rate = (done - 1) * self.batch_size / max(time.perf_counter() - start, 1e-9)
            metrics = EpochMetrics(epoch, loss, accuracy, rate)
            progress((epoch - 1) * n_steps + done, n_steps * self.options.epochs, metrics)
        return dataclasses.replace(metrics, held_out_accuracy=self.held_out_accuracy())

    def held_out_accuracy(self) -> float | None:
        """Return the accuracy on the held-out set; None if it is empty."""
        rows = self.held_out_rows
        if not len(rows):
            return None
        padded = np.resize(rows, len(rows) + -len(rows) % self.batch_size)
        remaining = range(len(rows), 0, -self.batch_size)
        correct = [
            count_correct(self.context, self.graph, self.state, batch, np.int32(n))
            for n, batch in zip(remaining, self.batches(padded), strict=True)
        ]
        return float(np.sum(jax.device_get(correct)) / len(rows))
