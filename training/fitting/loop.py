"""The training loop of all networks, with metrics and with checkpoints from which an interrupted fit resumes.

    checkpoints = Checkpoints(directory)
    state = checkpoints.last(state)
    for epoch in range(checkpoints.last_epoch + 1, epochs + 1):
        ...
        checkpoints.save(epoch, state, score)
    state = checkpoints.best(state)

Checkpoints of two epochs are kept: the last epoch and the epoch with the best score. A checkpoint is written atomically
before an older one is removed, so the last complete checkpoint survives any crash.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
import safetensors
from jax.experimental import multihost_utils

from thor2_jax.errors import InputError, decoding
from training.storage.jobs import Progress, load_arrays, save_arrays

__all__ = ["Checkpoints", "EpochMetrics", "FitOptions", "Steps", "fit_progress", "run_epochs", "wait_for_all"]

MAX_SEED = 2**31 - 1
"""Largest seed: JAX requires that it fits into 32 signed bits."""


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """Options for fitting a classifier.

    Attributes:
        epochs: number of epochs; the first half uses `learning_rates[0]`, the rest `learning_rates[1]`.
        learning_rates: Adam's two learning rates.
        batch_size: samples per step; an incomplete last batch is dropped, with different samples in each epoch.
        seed: seed for initial weights, sample order and dropout.

    Raises:
        InputError: a value is out of range; the message names the field and the value.
    """

    epochs: int = 100
    learning_rates: tuple[float, float] = (1e-2, 1e-3)
    batch_size: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch_size", 2), ("seed", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)}; it must be an integer of at least {least}")
        if self.seed > MAX_SEED:
            raise InputError(f"seed is {self.seed}; it must be at most {MAX_SEED}")


@dataclasses.dataclass(frozen=True)
class EpochMetrics:
    """Metrics of an epoch.

    Attributes:
        epoch: number of the epoch, from 1.
        loss: mean training loss of the epoch so far.
        accuracy: training accuracy of the epoch so far, with dropout.
        samples_per_second: training rate of the epoch so far, without its first step, which may compile; 0 after it.
        held_out_accuracy: accuracy on the held-out set after the epoch; None during the epoch or without the set.
    """

    epoch: int
    loss: float
    accuracy: float
    samples_per_second: float
    held_out_accuracy: float | None = None


def fit_progress(progress: Progress, stage: str, epochs: int) -> Callable[[int, int, EpochMetrics], object]:
    """Return the callback of a stage that fits networks in `epochs` epochs; its note contains the metrics."""

    def show(done: int, total: int, metrics: EpochMetrics) -> None:
        note = f"epoch {metrics.epoch}/{epochs}, loss {metrics.loss:.3f}, accuracy {metrics.accuracy:.3f}"
        rate = f", {metrics.samples_per_second:,.0f} samples/s" if metrics.samples_per_second else ""
        progress(stage, done, total, note + rate)

    return show


class Checkpoints:
    """Checkpoints in one directory, shared by all processes of a training; the first process writes them."""

    def __init__(self, directory: str | Path, log: Callable[[EpochMetrics], object] = lambda metrics: None) -> None:
        """Open or create the directory.

        Args:
            directory: directory for this fit only.
            log: called by the first process with the metrics of each epoch, before its checkpoint is written.

        Raises:
            InputError: a checkpoint is damaged.
            OSError: the directory cannot be created.
        """
        self.directory, self.log = Path(directory).absolute(), log
        self.directory.mkdir(parents=True, exist_ok=True)
        self._scores: dict[int, float] = {}
        for path in self.directory.glob("[0-9]*.safetensors"):
            with self._readable(path), safetensors.safe_open(path, "numpy") as file:
                self._scores[int(path.stem)] = float(file.metadata()["score"])

    @property
    def last_epoch(self) -> int:
        """Epoch of the last checkpoint; 0 if there is none."""
        return max(self._scores, default=0)

    @property
    def best_epoch(self) -> int:
        """Epoch of the checkpoint with the highest score, the latest one if scores are equal; 0 if there is none."""
        return max(self._scores, key=lambda epoch: (self._scores[epoch], epoch), default=0)

    def save(self, epoch: int, state: Any, score: float) -> None:
        """Write a checkpoint, and remove all but the last one and the best one.

        Args:
            epoch: number of the epoch, greater than the epoch of the last checkpoint.
            state: pytree of arrays, equal in all processes.
            score: quality of the state; higher is better.

        Raises:
            OSError: the checkpoint cannot be written, for example because the disk is full.
        """
        if jax.process_index() == 0:
            arrays = {str(number): np.asarray(leaf) for number, leaf in enumerate(jax.tree.leaves(state))}
            save_arrays(self._path(epoch), arrays, {"score": repr(score)})
        self._scores[epoch] = score
        for old in self._scores.keys() - {self.last_epoch, self.best_epoch}:
            del self._scores[old]
            if jax.process_index() == 0:
                self._path(old).unlink(missing_ok=True)

    def last(self, like: Any) -> Any:
        """Return the state of the last checkpoint, as NumPy arrays; without a checkpoint, return `like`.

        Args:
            like: a state with the same structure, shapes and dtypes.

        Raises:
            InputError: the checkpoint is damaged or has another structure.
        """
        return self._restore(self.last_epoch, like) if self.last_epoch else like

    def best(self, like: Any) -> Any:
        """Return the state of the checkpoint with the highest score, like `last`."""
        return self._restore(self.best_epoch, like)

    def _path(self, epoch: int) -> Path:
        return self.directory / f"{epoch}.safetensors"

    def _readable(self, path: Path) -> AbstractContextManager[None]:
        """Raise InputError if reading a checkpoint in the block fails."""
        return decoding(f"checkpoint: {path} cannot be read", advice=f"remove {self.directory} to restart this fit")

    def _restore(self, epoch: int, like: Any) -> Any:
        leaves, structure = jax.tree.flatten(like)
        with self._readable(self._path(epoch)):
            arrays = load_arrays(self._path(epoch))
            stored = [arrays[str(number)] for number in range(len(leaves))]
            for leaf, expected in zip(stored, leaves, strict=True):
                if (leaf.shape, leaf.dtype) != (expected.shape, expected.dtype):
                    raise ValueError(f"it has {leaf.dtype} {leaf.shape}; expected {expected.dtype} {expected.shape}")
            return jax.tree.unflatten(structure, stored)


def wait_for_all(point: str) -> None:
    """Wait until all processes have reached this point, so that none reads files before the first one wrote them."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(point)


STEPS_PER_REPORT = 20
"""Number of steps dispatched to the devices before their results are awaited; the host gathers batches meanwhile."""

State = TypeVar("State")


class Steps(NamedTuple):
    """Number of epochs of a fit, of steps per epoch, and of samples per step."""

    epochs: int
    of_epoch: int
    batch_size: int


def run_epochs(
    name: str,
    state: State,
    steps: Steps,
    train_epoch: Callable[[int, State], Iterator[tuple[State, Any]]],
    checkpoints: Checkpoints,
    *,
    progress: Callable[[int, int, EpochMetrics], object] = lambda done, total, metrics: None,
    held_out_accuracy: Callable[[State], float | None] = lambda state: None,
) -> State:
    """Train for all epochs, or for the epochs after the last checkpoint, and return the last state.

    Order and dropout should depend on seed, epoch and step only, so that a resumed fit gives exactly the same result.

    Args:
        name: name of the networks, for messages.
        state: pytree of the arrays that a step changes, after the last checkpoint (`Checkpoints.last`).
        steps: numbers of the fit.
        train_epoch: function of the number of an epoch, from 1, and the state before it. It makes the steps of the
            epoch, and yields the state after each step, with the loss and accuracy of its batch.
        checkpoints: checkpoints of this fit only, written after each epoch. Their score is the held-out accuracy or,
            without a held-out set, the negative loss.
        progress: called with (steps done, total steps, metrics of the epoch so far), for some of the steps.
        held_out_accuracy: function of the state after an epoch; None without a held-out set.

    Raises:
        InputError: the loss is not finite; the last checkpoint is kept.
        OSError: a checkpoint cannot be written; the previous one is kept.
    """
    for epoch in range(checkpoints.last_epoch + 1, steps.epochs + 1):
        total, pending, start = np.zeros(2), [], 0.0
        for number, (updated, computed) in enumerate(train_epoch(epoch, state), 1):
            state = updated
            pending.append(computed)
            if number == 1:
                jax.block_until_ready(computed)  # the first step may compile
                start = time.perf_counter()
            if number % STEPS_PER_REPORT and number < steps.of_epoch:
                continue
            total += np.sum(np.array(jax.device_get(pending), np.float64), axis=0)
            pending.clear()
            loss, accuracy = (total / number).tolist()
            if not math.isfinite(loss):
                raise InputError(
                    f"the training loss of {name} is {loss} in epoch {epoch}; it must be finite; check the views, or "
                    "try a smaller learning rate"
                )
            rate = (number - 1) * steps.batch_size / max(time.perf_counter() - start, 1e-9)
            metrics = EpochMetrics(epoch, loss, accuracy, rate)
            progress((epoch - 1) * steps.of_epoch + number, steps.epochs * steps.of_epoch, metrics)
        metrics = dataclasses.replace(metrics, held_out_accuracy=held_out_accuracy(state))
        if jax.process_index() == 0:
            checkpoints.log(metrics)
        score = -metrics.loss if metrics.held_out_accuracy is None else metrics.held_out_accuracy
        checkpoints.save(epoch, state, score)
    return state
