"""Options of a fit, metrics of an epoch, and their log: JSON lines, readable while the training runs."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.files import errors_name, write_text

__all__ = ["EpochMetrics", "FitOptions", "append_metrics", "discard_later_epochs", "read_metrics"]

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


def append_metrics(path: Path, fold: int, classifier: str, metrics: EpochMetrics) -> None:
    """Append the metrics of one epoch."""
    row = {"fold": fold, "classifier": classifier, **dataclasses.asdict(metrics)}
    with errors_name(path), path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Return the metrics of all epochs, without a last line that a crash cut off; an absent file has none.

    Raises:
        InputError: if any other line is damaged.
    """
    content = path.read_bytes() if path.exists() else b""
    try:
        rows = [json.loads(line) for line in content.split(b"\n")[:-1]]
        for row in rows:
            if not (isinstance(row["epoch"], int) and {"fold", "classifier"} <= row.keys()):
                raise ValueError("a line has no fold, classifier and epoch")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"out: {path} is damaged ({error}); remove it, or choose another directory") from None
    return rows


def discard_later_epochs(path: Path, fold: int, classifier: str, epoch: int) -> None:
    """Remove the lines of a classifier after `epoch`, where its training resumes and appends them again."""
    rows = read_metrics(path)
    kept = [r for r in rows if (r["fold"], r["classifier"]) != (fold, classifier) or r["epoch"] <= epoch]
    write_text(path, "".join(json.dumps(row) + "\n" for row in kept))
