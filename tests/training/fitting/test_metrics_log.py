"""The metrics log: one JSON line for each epoch, classifier and fold."""

import json
from pathlib import Path

import pytest

import thor2_jax as thor2
from training.fitting.options import EpochMetrics, append_metrics, discard_later_epochs, read_metrics


def metrics(epoch: int) -> EpochMetrics:
    return EpochMetrics(epoch, 1 / epoch, 0.5, 1000.0)


def test_metrics_are_appended_and_discarded(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    assert read_metrics(path) == []
    for fold in (0, 1):
        for name in ("ce", "tops"):
            for epoch in (1, 2, 3):
                append_metrics(path, fold, name, metrics(epoch))
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert rows == read_metrics(path) and len(rows) == 12
    assert rows[4] == {
        "fold": 0,
        "classifier": "tops",
        "epoch": 2,
        "loss": 0.5,
        "accuracy": 0.5,
        "samples_per_second": 1000.0,
        "held_out_accuracy": None,
    }
    discard_later_epochs(path, 1, "ce", 1)
    kept = [(row["fold"], row["classifier"], row["epoch"]) for row in read_metrics(path)]
    assert kept == [
        (f, n, e) for f in (0, 1) for n in ("ce", "tops") for e in (1, 2, 3) if (f, n) != (1, "ce") or e < 2
    ]


def test_an_incomplete_last_line_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    append_metrics(path, 0, "ce", metrics(1))
    with path.open("a") as file:
        file.write('{"fold": 0, "cl')
    assert [row["epoch"] for row in read_metrics(path)] == [1]
    discard_later_epochs(path, 0, "ce", 1)
    append_metrics(path, 0, "ce", metrics(2))
    assert [row["epoch"] for row in read_metrics(path)] == [1, 2]


def test_damage_and_a_missing_directory_are_errors(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text("no json\n{}\n")
    with pytest.raises(thor2.InputError, match=r"out: .*metrics\.jsonl"):
        read_metrics(tmp_path / "metrics.jsonl")
    with pytest.raises(OSError):
        append_metrics(tmp_path / "absent" / "metrics.jsonl", 0, "ce", metrics(1))
