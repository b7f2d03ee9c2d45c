"""Damaged run directories."""

import dataclasses
import json
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from helpers import untrained_run
from hypothesis import given, settings
from hypothesis import strategies as st

import thor2_jax as thor2
from thor2_jax.model.run_directory import load_run, save_run
from thor2_jax.testing import damaged

from .conftest import other_content


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "run"
    save_run(untrained_run(("mug", "bowl"), ("ce",), record={"epochs": 3}), path)
    assert load_run(path).classes == ("mug", "bowl")
    return path


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

    with other_content(run / "run.json", other):
        loaded = attempt(read)
    if loaded is not None:
        assert isinstance(loaded.config, thor2.DescriptorConfig) and isinstance(loaded.record, dict)
        assert loaded.classes and all(isinstance(name, str) for name in loaded.classes)


@settings(max_examples=30)
@given(data=st.data())
def test_files_of_weights_and_network(data: st.DataObject, run: Path, attempt: Any) -> None:
    files = sorted(p for p in run.rglob("*") if p.is_file() and p.name != "run.json" and p.stat().st_size)
    path = data.draw(st.sampled_from(files))
    content = data.draw(damaged(path.read_bytes()))
    same = content == path.read_bytes()
    with other_content(path, content):
        loaded = attempt(lambda: same or load_run(run))
    assert (loaded is None) == (not same)


@pytest.mark.parametrize("value", ["9" * 5000, "[" * 10**5, "1e400", "-1", "null", "10000000"])
def test_odd_numbers(value: str, run: Path, attempt: Any) -> None:
    """Sizes that would fill memory are compared with the shapes of the weights before any array is allocated."""
    table = json.loads((run / "run.json").read_bytes())
    for key in ("n_slices", "n_strips"):
        changed = table | {"descriptor_config": table["descriptor_config"] | {key: "PART"}}
        with other_content(run / "run.json", json.dumps(changed).replace('"PART"', value).encode()):
            assert attempt(lambda: load_run(run)) is None
