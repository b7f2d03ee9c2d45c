"""Damaged run directories, and damaged files of trainings and evaluations."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from helpers import untrained_run
from hypothesis import given, settings
from hypothesis import strategies as st

import thor2_jax as thor2
from thor2_jax.model.run_directory import load_run, save_run
from thor2_jax.testing import damaged
from training.baselines.files import StoredBaseline, read_baseline, write_baseline
from training.evaluation.answers import AnswerFile, FrameAnswers, InstancePrediction
from training.fitting.options import read_metrics


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "run"
    save_run(untrained_run(("mug", "bowl"), ("ce",), record={"epochs": 3}), path)
    return path


def read_damaged(path: Path, content: bytes, read: Any, attempt: Any) -> Any:
    """Call a reader while a file has another content, and restore the file."""
    before = path.read_bytes()
    path.write_bytes(content)
    try:
        return attempt(read)
    finally:
        path.write_bytes(before)


@given(data=st.data())
def test_descriptions(data: st.DataObject, run: Path, attempt: Any) -> None:
    """A damaged run.json is refused or read as a run with valid types; weights are not restored here."""
    content = (run / "run.json").read_bytes()
    if data.draw(st.booleans()):
        other = data.draw(damaged(content))
    else:
        table = json.loads(content)
        key = data.draw(st.sampled_from(sorted(table)))
        part = data.draw(damaged(json.dumps(table[key]).encode()))
        other = json.dumps(table | {key: "PART"}).encode().replace(b'"PART"', part)

    def read() -> Any:
        with mock.patch("thor2_jax.model.run_directory.model_from_arrays"):
            return dataclasses.replace(load_run(run), classifiers={})

    loaded = read_damaged(run / "run.json", other, read, attempt)
    if loaded is not None:
        assert isinstance(loaded.config, thor2.DescriptorConfig) and isinstance(loaded.record, dict)
        assert loaded.classes and all(isinstance(name, str) for name in loaded.classes)


@settings(max_examples=30)
@given(data=st.data())
def test_files_of_weights_and_network(data: st.DataObject, run: Path, attempt: Any) -> None:
    files = sorted(p for p in run.rglob("*") if p.is_file() and p.name != "run.json" and p.stat().st_size)
    path = data.draw(st.sampled_from(files))
    other = data.draw(damaged(path.read_bytes()))
    same = other == path.read_bytes()
    loaded = read_damaged(path, other, lambda: same or load_run(run), attempt)
    assert (loaded is None) == (not same)


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 10**5, "1e400", "-1", "null"])
def test_odd_numbers(value: str, run: Path, attempt: Any) -> None:
    for key in ("n_slices", "sigma_s", "image_size"):
        table = json.loads((run / "run.json").read_bytes())
        table["descriptor_config"][key] = "PART"
        other = json.dumps(table).replace('"PART"', value).encode()
        assert read_damaged(run / "run.json", other, lambda: load_run(run), attempt) is None


def test_sizes_that_would_fill_memory(run: Path, attempt: Any, tmp_path: Path) -> None:
    """The shapes of the weights are compared before any array is allocated."""
    path = Path(shutil.copytree(run, tmp_path / "run"))
    for key in ("n_slices", "n_strips"):
        table = json.loads((run / "run.json").read_bytes())
        table["descriptor_config"][key] = 10**7
        (path / "run.json").write_text(json.dumps(table))
        assert attempt(lambda: load_run(path)) is None


EVALUATION = {"runs": ["a"], "classes": ["mug", "bowl"]}


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("answers") / "answers.jsonl"
    file = AnswerFile(path, EVALUATION)
    for number in range(2):
        prediction = InstancePrediction(1, "mug", probabilities=np.array([[0.25, 0.75]], np.float32))
        file.append(
            FrameAnswers(
                f"frame {number}", {"light": "1"}, 0.5, [prediction, InstancePrediction(2, "can", reason="few")]
            )
        )
    return path.read_bytes()


@given(data=st.data())
def test_answers(data: st.DataObject, answers: bytes, attempt: Any, tmp_path_factory: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "answers.jsonl"
    path.write_bytes(data.draw(damaged(answers)))
    file = attempt(lambda: AnswerFile(path, EVALUATION))
    if file is not None:
        tables = [instance.probabilities for frame in file.frames for instance in frame.instances]
        assert all(table is None or (table.dtype, table.ndim) == (np.float32, 2) for table in tables)


@given(data=st.data())
def test_baselines(data: st.DataObject, attempt: Any, tmp_path_factory: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "baselines" / "forest.safetensors"
    stored = StoredBaseline({"a": np.arange(6.0).reshape(2, 3), "b": np.array([1], np.int32)}, 1.5, 2.0)
    write_baseline(path, stored, ["mug"])
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    loaded = attempt(lambda: read_baseline(path, ["mug"]))
    if loaded is not None:
        assert (loaded.temperature, loaded.seconds) == (1.5, 2.0) and loaded.arrays.keys() == stored.arrays.keys()
        assert all(np.array_equal(loaded.arrays[name], array) for name, array in stored.arrays.items())


ROWS = b"".join(
    json.dumps({"fold": 0, "classifier": "ce", "epoch": k, "loss": 0.5, "accuracy": 0.75}).encode() + b"\n"
    for k in range(3)
)


@given(content=damaged(ROWS))
def test_metrics(content: bytes, attempt: Any, tmp_path_factory: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "metrics.jsonl"
    path.write_bytes(content)
    rows = attempt(lambda: read_metrics(path))
    assert rows is None or all((row["fold"], row["classifier"], row["epoch"]) for row in rows)


def test_whole_runs_are_read(run: Path) -> None:
    assert load_run(run).classes == ("mug", "bowl") and np.isfinite(load_run(run).config.sigma_s)
