"""Figures of a training as JSON lines, one an epoch, classifier and fold: to be read while it runs, and for curves."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from training.fitting.options import EpochMetrics

__all__ = ["append_figures", "forget_after", "read_figures"]

_WHOSE = {"fold", "classifier"}


def append_figures(path: Path, fold: int, classifier: str, figures: EpochMetrics) -> None:
    """Add one line."""
    row = {"fold": fold, "classifier": classifier, **dataclasses.asdict(figures)}
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


def read_figures(path: Path) -> list[dict[str, Any]]:
    """All lines; none if there is no such file. A last line that a crash cut off is left out.

    Raises:
        InputError: another line is no record.
    """
    content = path.read_bytes() if path.exists() else b""
    try:
        rows = [json.loads(line) for line in content.split(b"\n")[:-1]]
        if not all(
            isinstance(row, dict) and isinstance(row.get("epoch"), int) and _WHOSE <= row.keys() for row in rows
        ):
            raise ValueError("a line is no record")
    except (ValueError, RecursionError) as error:
        raise InputError(f"out: {path} is damaged ({error})") from None
    return rows


def forget_after(path: Path, fold: int, classifier: str, epoch: int) -> None:
    """Remove the lines of a fold's classifier past that epoch: it goes on from there, and will write them again."""
    rows = read_figures(path)
    kept = [r for r in rows if (r["fold"], r["classifier"]) != (fold, classifier) or r["epoch"] <= epoch]
    write_text(path, "".join(json.dumps(row) + "\n" for row in kept))
