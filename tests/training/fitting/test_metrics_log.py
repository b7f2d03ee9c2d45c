"""The metrics log: one JSON line for each epoch, classifier and fold."""

import dataclasses
import itertools
from pathlib import Path

import pytest
from helpers import json_lines

import thor2_jax as thor2
from training.fitting.options import EpochMetrics, append_metrics, discard_later_epochs, read_metrics


def metrics(epoch: int) -> EpochMetrics:
    return EpochMetrics(epoch, 1 / epoch, 0.5, 1000.0)


def test_metrics_are_appended_and_discarded(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    assert read_metrics(path) == []
    keys = list(itertools.product((0, 1), ("ce", "tops"), (1, 2, 3)))
    for fold, name, epoch in keys:
        append_metrics(path, fold, name, metrics(epoch))
    rows = json_lines(path.read_text())
    assert rows == read_metrics(path) and len(rows) == 12
    assert rows[4] == {"fold": 0, "classifier": "tops", **dataclasses.asdict(metrics(2))}
    discard_later_epochs(path, 1, "ce", 1)
    kept = [(row["fold"], row["classifier"], row["epoch"]) for row in read_metrics(path)]
    assert kept == [key for key in keys if key[:2] != (1, "ce") or key[2] == 1]


def test_an_incomplete_last_line_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    append_metrics(path, 0, "ce", metrics(1))
    with path.open("a") as file:
        file.write('{"fold": 0, "cl')
    assert [row["epoch"] for row in read_metrics(path)] == [1]
    discard_later_epochs(path, 0, "ce", 1)
    append_metrics(path, 0, "ce", metrics(2))
    assert [row["epoch"] for row in read_metrics(path)] == [1, 2]
    path.write_text("no json\n{}\n")
    with pytest.raises(thor2.InputError, match=r"out: .*metrics\.jsonl"):
        read_metrics(path)
