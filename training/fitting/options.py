"""What a fit is given and what it reports: options, metrics of an epoch, progress."""

import dataclasses
import math
from collections.abc import Callable

from thor2_jax.errors import InputError

__all__ = ["EpochMetrics", "FitOptions", "Progress"]

Progress = Callable[[str, int, int, str], object]
"""Called with (stage, done, total, note)."""

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
class EpochMetrics:
    """How an epoch goes.

    Attributes:
        epoch: counted from 1.
        loss: mean over the epoch's training samples so far.
        accuracy: of the same, with dropout.
        samples_per_second: of the epoch so far, from the end of its first step (which may compile).
        held_out_accuracy: of the samples held out, at the end of the epoch; None before, or if there are none.
    """

    epoch: int
    loss: float
    accuracy: float
    samples_per_second: float
    held_out_accuracy: float | None = None
