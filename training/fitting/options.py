"""Options of a fit, and metrics of an epoch."""

import dataclasses
import math

from thor2_jax.errors import InputError

__all__ = ["EpochMetrics", "FitOptions"]

MAX_SEED = 2**31 - 1
"""Largest seed that fits into 32 signed bits, as JAX requires."""


@dataclasses.dataclass(frozen=True)
class FitOptions:
    """How a classifier is fitted.

    Attributes:
        epochs: number of epochs; the first half uses `learning_rates[0]`, the rest `learning_rates[1]`.
        learning_rates: Adam's two learning rates.
        batch_size: samples per step; an incomplete last batch is dropped (other samples in each epoch).
        seed: seed for initial weights, sample order and dropout.

    Raises:
        InputError: A value is out of range; the message names the field and the value.
    """

    epochs: int = 100
    learning_rates: tuple[float, float] = (1e-2, 1e-3)
    batch_size: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("epochs", 1), ("batch_size", 2), ("seed", 0)):
            if type(getattr(self, name)) is not int or getattr(self, name) < least:
                raise InputError(f"{name} is {getattr(self, name)!r}; it must be an integer of at least {least}")
        if self.seed > MAX_SEED:
            raise InputError(f"seed is {self.seed}; it must be at most {MAX_SEED}")
        rates = self.learning_rates
        if len(rates) != 2 or not all(isinstance(rate, int | float) and 0 < rate < math.inf for rate in rates):
            raise InputError(f"learning_rates is {rates!r}; it must be two positive numbers")


@dataclasses.dataclass(frozen=True)
class EpochMetrics:
    """Metrics of an epoch.

    Attributes:
        epoch: number of the epoch, from 1.
        loss: mean training loss of the epoch so far.
        accuracy: training accuracy of the epoch so far, with dropout.
        samples_per_second: training rate of the epoch so far, without its first step, which may compile.
        held_out_accuracy: accuracy on the held-out set after the epoch; None before, or without a held-out set.
    """

    epoch: int
    loss: float
    accuracy: float
    samples_per_second: float
    held_out_accuracy: float | None = None

    def describe(self, epochs: int) -> str:
        """Return the metrics as a note for a progress display, of `epochs` in all."""
        return (
            f"epoch {self.epoch}/{epochs}, loss {self.loss:.3f}, accuracy {self.accuracy:.3f}, "
            f"{self.samples_per_second:,.0f} samples/s"
        )
