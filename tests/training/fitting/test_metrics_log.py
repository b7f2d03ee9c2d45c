"""The file of figures."""

import json
from pathlib import Path

import pytest

import thor2_jax as thor2
from training.fitting.metrics_log import append_figures, forget_after, read_figures
from training.fitting.options import EpochMetrics


def figures(epoch: int) -> EpochMetrics:
    return EpochMetrics(epoch, 1 / epoch, 0.5, 1000.0)


def test_lines_are_added_and_forgotten(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    assert read_figures(path) == []
    for fold in (0, 1):
        for name in ("ce", "tops"):
            for epoch in (1, 2, 3):
                append_figures(path, fold, name, figures(epoch))
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    assert rows == read_figures(path) and len(rows) == 12
    assert rows[4] == {
        "fold": 0,
        "classifier": "tops",
        "epoch": 2,
        "loss": 0.5,
        "accuracy": 0.5,
        "samples_per_second": 1000.0,
        "held_out_accuracy": None,
    }
    forget_after(path, 1, "ce", 1)
    kept = [(row["fold"], row["classifier"], row["epoch"]) for row in read_figures(path)]
    assert kept == [
        (f, n, e) for f in (0, 1) for n in ("ce", "tops") for e in (1, 2, 3) if (f, n) != (1, "ce") or e < 2
    ]


def test_a_line_that_was_cut_off_is_left_out_and_the_next_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    append_figures(path, 0, "ce", figures(1))
    with path.open("a") as file:
        file.write('{"fold": 0, "cl')
    assert [row["epoch"] for row in read_figures(path)] == [1]
    forget_after(path, 0, "ce", 1)
    append_figures(path, 0, "ce", figures(2))
    assert [row["epoch"] for row in read_figures(path)] == [1, 2]


def test_damage_and_no_folder(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text("no json\n{}\n")
    with pytest.raises(thor2.InputError, match="metrics.jsonl is damaged"):
        read_figures(tmp_path / "metrics.jsonl")
    with pytest.raises(OSError):
        append_figures(tmp_path / "absent" / "metrics.jsonl", 0, "ce", figures(1))
