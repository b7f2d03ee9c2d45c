"""Training on several devices and in two processes against one device, in separate processes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import json_lines
from processes import HANG, finish_programs, free_port, start_program

_PROGRAM = """
import sys
from pathlib import Path
folder, port, rank = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
import jax
if port != "0":
    jax.distributed.initialize(f"localhost:{port}", 2, rank)
from small_clouds import brick_and_stick
from small_runs import SMALL_CONFIG
from thor2_jax.model.run_directory import save_run
from training.fitting.loop import FitOptions
from training.train_run import train_run
from training.protocol import Protocol
from training.views.normalized_views import MemoryViews

views, devices = MemoryViews(brick_and_stick(16), SMALL_CONFIG), jax.devices()
settings = Protocol(["tops2"], FitOptions(epochs=2, batch_size=16), SMALL_CONFIG, 2)
for count in map(int, sys.argv[4:]):  # the training sees as many of the devices
    jax.devices, jax.device_count = (lambda: devices[:count]), (lambda: count)
    for fold, run in enumerate(train_run(views, folder / f"{count}", settings)):
        save_run(run, folder / f"{count}-{rank}-{fold}")
"""


def curve(out: Path) -> list[tuple[Any, ...]]:
    rows = json_lines((out / "metrics.jsonl").read_text())
    assert [(row["fold"], row["epoch"]) for row in rows] == [(fold, epoch) for fold in (0, 1) for epoch in (1, 2)]
    return [(row["loss"], row["accuracy"], row["held_out_accuracy"]) for row in rows]


def weights(folder: Path, rank: int) -> list[bytes]:
    return [(folder / f"2-{rank}-{fold}" / "weights" / "tops2.safetensors").read_bytes() for fold in (0, 1)]


@pytest.mark.slow
def test_two_processes_reach_the_weights_of_one(tmp_path: Path) -> None:
    """Weights equal those of one process with two devices, and the curve those of one device and of eight."""
    alone, pair, port = tmp_path / "alone", tmp_path / "pair", free_port()
    finish_programs(start_program(_PROGRAM, alone, 0, 0, 1, 2, 8, devices=8))
    finish_programs(*(start_program(_PROGRAM, pair, port, rank, 2) for rank in (0, 1)))
    for out in (pair / "2", alone / "8"):
        np.testing.assert_allclose(curve(out), curve(alone / "1"), rtol=2e-3, atol=2e-3)
    assert {path.name for path in (pair / "2").iterdir()} == {"curves.png", "fold-0", "fold-1", "metrics.jsonl"}
    assert weights(pair, 0) == weights(pair, 1) == weights(alone, 0)


_FAILING = """
import sys
from training import train_job
from training.cli import main
from training.fitting.loop import wait_for_all
rank, port = sys.argv[1:]

def fail_alone(*_):
    wait_for_all("begun")
    if rank == "0":
        raise OSError("the disk is full")
    wait_for_all("finished")

train_job.run_train_job = fail_alone
sys.argv[1:] = ["train", "--dataset", "views", "--out", "run", "--coordinator", f"localhost:{port}"]
sys.argv += ["--processes", "2", "--process", rank]
main()
"""


@pytest.mark.slow
def test_an_error_in_one_process_ends_both() -> None:
    port = free_port()
    first, second = (start_program(_FAILING, rank, port) for rank in (0, 1))
    assert "error: the disk is full" in first.communicate(timeout=HANG)[1] and first.returncode == 2
    message = second.communicate(timeout=HANG)[1]
    assert "error: --coordinator: another process has ended" in message or "another task died" in message
