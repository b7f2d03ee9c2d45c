"""The training loop of all networks: steps, metrics, and checkpoints from which an interrupted fit resumes."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from thor2_jax.errors import InputError
from training.fitting.checkpoints import Checkpoints
from training.fitting.options import EpochMetrics

__all__ = ["Steps", "run_epochs"]

STEPS_PER_REPORT = 20
"""Steps dispatched to the devices before their results are awaited: the host gathers batches meanwhile."""

State = TypeVar("State")
Item = TypeVar("Item")


class Steps(NamedTuple):
    """Numbers of a fit: its epochs, the steps of an epoch, and the samples of a step."""

    epochs: int
    of_epoch: int
    batch_size: int


def run_epochs(
    name: str,
    state: State,
    steps: Steps,
    batches: Callable[[int], Iterable[Item]],
    step: Callable[[State, int, Item], tuple[State, Any]],
    checkpoints: Checkpoints | None = None,
    *,
    progress: Callable[[int, int, EpochMetrics], object] = lambda done, total, metrics: None,
    epoch_done: Callable[[EpochMetrics], object] = lambda metrics: None,
    held_out_accuracy: Callable[[State], float | None] = lambda state: None,
    place: Callable[[State], State] = lambda state: state,
) -> State:
    """Train for all epochs, or for those after the last checkpoint, and return the last state.

    Order and dropout should depend on seed, epoch and step only, so that a resumed fit gives the same bits.

    Args:
        name: name of the networks, for messages.
        state: pytree of the arrays that a step changes.
        steps: numbers of the fit.
        batches: function of an epoch, from 1, that yields its batches.
        step: function of the state, the number of the step, from 0, and a batch that returns the next state, and loss
            and accuracy of the batch.
        checkpoints: of this fit only, written after each epoch; None writes none. The score of one is the held-out
            accuracy or, without one, the negative loss.
        progress: called with (steps done, total steps, metrics of the epoch so far), for some of the steps.
        epoch_done: called after each epoch, before its checkpoint is written.
        held_out_accuracy: function of the state after an epoch; None without a held-out set.
        place: function that moves a state to the devices.

    Raises:
        InputError: the loss is not finite (the last checkpoint stays), or a checkpoint is unreadable.
        OSError: a checkpoint cannot be written; the previous one stays.
    """
    done = 0 if checkpoints is None else checkpoints.last_epoch
    if checkpoints is not None and done:
        state = checkpoints.last(state)
    state = place(state)
    for epoch in range(done + 1, steps.epochs + 1):
        total, pending, start = np.zeros(2), [], 0.0
        for number, batch in enumerate(batches(epoch), 1):
            state, computed = step(state, (epoch - 1) * steps.of_epoch + number - 1, batch)
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
        epoch_done(metrics)
        if checkpoints is not None:
            score = -metrics.loss if metrics.held_out_accuracy is None else metrics.held_out_accuracy
            checkpoints.save(epoch, state, score)
    return state
