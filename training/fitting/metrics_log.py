"""Training metrics as JSON lines, one for each epoch, classifier and fold; readable while the training runs."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.files import errors_name, write_text
from training.fitting.options import EpochMetrics

__all__ = ["append_metrics", "discard_later_epochs", "read_metrics"]


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
